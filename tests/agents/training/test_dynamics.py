"""Agents on the backend dart: training, resuming, and the transfer of a policy to other backends."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.inspection.transfer import transfer
from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.evaluation import evaluate_run, make_env
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.callbacks import OnProgress
from gym_mara.agents.training.train import resume, train
from gym_mara.backends.processes import WorkerDiedError
from gym_mara.backends.workers import WorkerBackend
from gym_mara.errors import GymMaraError
from tests.agents.conftest import config, silent
from tests.agents.training.test_train import assert_same_training

pytestmark = pytest.mark.slow

ROLLOUT = 16 * 32
HIGHEST = ("highest_torque", "highest_velocity")
SMALL = Preset(num_envs=16, policy="natural", arguments={"n_steps": 32, "batch_size": 128})


def _train(out: Path, on_progress: OnProgress = silent, updates: int = 2) -> RunFolder:
    """A run on dart, with random parameters and few arms."""
    options = {"randomisation": {"mass": [0.9, 1.1], "sensor_noise": [0.0, 1e-3]}}
    about: dict[str, Any] = {"env": "MARA-v0", "backend": "dart", "env_options": options}
    about |= {"steps": updates * ROLLOUT, "checkpoint_every": ROLLOUT}
    return train(config(**about), out, on_progress, preset=SMALL)


@pytest.fixture(scope="module")
def dynamic_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    """A finished run; tests must not change it."""
    return _train(tmp_path_factory.mktemp("dynamic") / "run")


def test_an_interrupted_run_is_resumed_with_the_same_result(
    dynamic_run: RunFolder, tmp_path: Path
) -> None:
    def interrupt(steps: int, shown: dict[str, float]) -> None:
        if steps > ROLLOUT:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        _train(tmp_path / "run", interrupt)
    assert_same_training(dynamic_run, resume(tmp_path / "run", silent))


def test_a_run_is_resumed_after_a_worker_has_died(
    dynamic_run: RunFolder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[WorkerBackend] = []
    original = WorkerBackend.__init__

    def remember(self: WorkerBackend, *arguments: Any) -> None:
        original(self, *arguments)
        made.append(self)

    def kill(steps: int, shown: dict[str, float]) -> None:
        if steps > ROLLOUT:
            made[0].processes[0].kill()

    monkeypatch.setattr(WorkerBackend, "__init__", remember)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1}, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cores: None, raising=False)
    with pytest.raises(WorkerDiedError):
        _train(tmp_path / "run", kill, updates=3)
    run = RunFolder.open(tmp_path / "run")
    assert [int(folder.name) for folder in run.checkpoints()] == [ROLLOUT]
    assert resume(tmp_path / "run", silent).has_policy("last")


def test_a_policy_plays_on_another_backend(finished_run: RunFolder, dynamic_run: RunFolder) -> None:
    for run, backend in ((finished_run, "dart"), (dynamic_run, "pinocchio")):
        metrics = evaluate_run(run, backend=backend, episodes=1)
        assert all(np.isfinite(values).all() for values in metrics.values())


def test_transfer_plays_a_policy_on_every_backend(dynamic_run: RunFolder) -> None:
    options = {"randomisation": {"mass": (0.5, 1.5)}}
    rows = transfer(dynamic_run, backends=["dart", "pinocchio"], episodes=2, options=options)
    for row in rows:
        for name, values in row.metrics.items():
            assert np.shape(values) == (2,)
            assert name in ("settling_time_s", *HIGHEST) or np.isfinite(values).all()
    _, dynamic, teleport, _ = rows
    assert ((dynamic.highest_torque > 0.0) & (dynamic.highest_torque <= 1.01)).all()
    assert dynamic.highest_torque[0] != dynamic.highest_torque[1]
    assert (dynamic.highest_velocity > 0.1).all()
    assert np.isnan(teleport.highest_torque).all()
    assert np.isnan(teleport.highest_velocity).all()
    played = evaluate_run(dynamic_run, backend="pinocchio", episodes=1)
    np.testing.assert_allclose(teleport.return_[0], played["return"][0], rtol=1e-4)
    np.testing.assert_allclose(
        teleport.position_error_mm[0], played["position_error_mm"][0], rtol=1e-4
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"episodes": 0}, "episodes must be a whole number of at least 1"),
        ({"options": {"colour": 1}}, "unknown keyword argument 'colour' on any of"),
        ({"which": "worst"}, "unknown policy"),
    ],
)
def test_wrong_arguments_of_a_transfer_are_an_error(
    dynamic_run: RunFolder, arguments: dict[str, Any], message: str
) -> None:
    with pytest.raises(GymMaraError, match=message):
        transfer(dynamic_run, **arguments)


def test_a_policy_with_other_spaces_is_refused(dynamic_run: RunFolder) -> None:
    simulation = make_env("MARAOrient-v0", "pinocchio", 1, {}).env.simulation
    with pytest.raises(GymMaraError, match="does not fit the environment"):
        load_policy(dynamic_run).check(simulation)
