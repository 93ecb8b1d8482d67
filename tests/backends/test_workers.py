"""Arms spread over processes: the same bits as in one, and what happens when a process dies."""

from __future__ import annotations

import os
import signal
from typing import Any

import numpy as np
import pytest

from gym_mara.backends import Backend, make_backend
from gym_mara.backends.dart.backend import SimulationDivergedError
from gym_mara.backends.workers import WorkerBackend, WorkerDiedError
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import assert_same_state, uniform_q

RANDOM = {"mass": (0.8, 1.2), "servo_gain": (0.7, 1.3), "latency": (0.0, 0.05)}


def _make(robot: RobotModel, workers: int, **settings: Any) -> Backend:
    return make_backend("dart", robot, 4, {"workers": workers, **settings})


@pytest.mark.parametrize("settings", [{}, {"randomisation": RANDOM}], ids=["plain", "random"])
def test_the_numbers_do_not_depend_on_the_number_of_processes(
    mara: RobotModel, settings: dict[str, Any]
) -> None:
    backends = [_make(mara, workers, **settings) for workers in (1, 2, 4)]
    rng = np.random.default_rng(0)
    q, targets = uniform_q(mara, 4, seed=1), rng.uniform(-1.5, 1.5, (6, 4, 6))
    seeds = rng.integers(2**63, size=4, dtype=np.uint64)
    runs = []
    for backend in backends:
        if settings:
            backend.begin_episodes(seeds, np.ones(4, np.bool_))
        backend.reset(q)
        run = [(backend.step(target), backend.report()) for target in targets[:3]]
        backend.reset(np.zeros((4, 6)), np.array([True, False, False, True]))
        runs.append(run + [(backend.step(target), backend.report()) for target in targets[3:]])
        backend.close()
    for run in runs[1:]:
        for (state, report), (expected, expected_report) in zip(run, runs[0], strict=True):
            assert_same_state(state, expected)
            assert str(report) == str(expected_report)


@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1), (2, 4)])
def test_a_snapshot_fits_any_number_of_processes(mara: RobotModel, before: int, after: int) -> None:
    first, second = (_make(mara, n, randomisation=RANDOM) for n in (before, after))
    first.begin_episodes(np.arange(4, dtype=np.uint64), np.ones(4, np.bool_))
    first.reset(uniform_q(mara, 4, seed=2))
    targets = np.random.default_rng(1).uniform(-1.5, 1.5, (6, 4, 6))
    for target in targets[:3]:
        first.step(target)
    second.restore(first.save())
    for target in targets[3:]:
        assert_same_state(second.step(target), first.step(target))
        assert str(second.report()) == str(first.report())
    first.close()
    second.close()


def test_arms_that_cannot_be_shared_out_equally_are_refused(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="workers=3 must divide the number of arms, 4"):
        _make(mara, 3)


def test_by_default_there_is_a_process_for_each_core_that_can_have_equal_shares(
    mara: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1}, raising=False)
    spread = make_backend("dart", mara, 4, {})
    assert isinstance(spread, WorkerBackend)
    spread.close()
    assert not isinstance(make_backend("dart", mara, 3, {}), WorkerBackend)


def _kill(backend: Backend) -> None:
    assert isinstance(backend, WorkerBackend)
    process = backend.processes[1]
    os.kill(process.pid, signal.SIGKILL)
    process.join()


def test_a_worker_that_dies_is_an_error_and_takes_the_others_along(mara: RobotModel) -> None:
    backend = _make(mara, 2)
    _kill(backend)
    with pytest.raises(WorkerDiedError, match="worker process"):
        backend.step(np.zeros((4, 6)))
    assert isinstance(backend, WorkerBackend)
    assert not any(process.is_alive() for process in backend.processes)
    backend.close()


def test_closing_is_not_held_up_by_a_dead_worker(mara: RobotModel) -> None:
    backend = _make(mara, 2)
    _kill(backend)
    backend.close()


@pytest.mark.filterwarnings("ignore:.*ERROR")  # Gymnasium shows the worker's traceback
def test_an_error_in_a_worker_comes_through(mara: RobotModel) -> None:
    backend = _make(mara, 2)
    snapshot = backend.save()
    snapshot["qd"][2] = 1e200
    backend.restore(snapshot)
    with pytest.raises(SimulationDivergedError, match="diverged"):
        backend.step(np.zeros((4, 6)))
