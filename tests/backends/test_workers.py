"""Arms in worker processes: the numbers of one process, and no process left whatever happens."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from gym_mara.backends import Backend, make_backend
from gym_mara.backends.processes import WorkerDiedError
from gym_mara.backends.servo import SimulationDivergedError
from gym_mara.backends.workers import WorkerBackend
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.testing import assert_same_state, uniform_q
from gym_mara.types import Floats
from tests.backends.fake import FakeBackend
from tests.helpers import robot_model, started, write

RANDOM = {
    "mass": (0.8, 1.2),
    "servo_gain": (0.7, 1.3),
    "latency": (0.0, 0.05),
    "sensor_noise": (0.0, 0.1),
}
START_METHODS = multiprocessing.get_all_start_methods()
STILL = np.zeros((4, 6))


def _make(robot: RobotModel, workers: int, **settings: Any) -> Backend:
    return make_backend("dart", robot, 4, {"workers": workers, **settings})


class TroubledBackend(FakeBackend):
    """Fails, or takes long, in a step towards a certain target; closing it leaves a file."""

    def __init__(self, robot: RobotModel, num_envs: int, *, closed: str = "") -> None:
        super().__init__(robot, num_envs)
        self._file = closed

    def step(self, q_target: Floats) -> SimState:
        asked = q_target[0, 0]
        if asked == 0.1:
            raise GymMaraError("a target that nobody likes")
        if asked == 0.2:
            raise ZeroDivisionError("by nothing")
        if asked == 0.3:
            raise _Unpicklable("a lambda within", lambda: None)
        if asked == 0.4:
            time.sleep(60.0)
        return super().step(q_target)

    def save(self) -> dict[str, Any]:
        return {"q": np.array([lambda: None] * self.num_envs)}

    def close(self) -> None:
        if self._file:
            Path(self._file).touch()


class _Unpicklable(Exception):  # noqa: N818
    pass


def _troubled(settings: dict[str, Any] | None = None) -> WorkerBackend:
    return WorkerBackend(TroubledBackend, robot_model("mara"), 4, 2, settings or {})


def _target(second_block: float) -> Floats:
    """Targets (4, 6) with a value for the first joint of each arm of the second block."""
    target = STILL.copy()
    target[2:, 0] = second_block
    return target


@pytest.fixture(params=START_METHODS)
def start_method(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each of the ways in which this system starts processes."""
    before = multiprocessing.get_start_method()
    multiprocessing.set_start_method(request.param, force=True)
    yield request.param
    multiprocessing.set_start_method(before, force=True)


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
        backend.begin_episodes(seeds, np.ones(4, np.bool_))
        backend.reset(q)
        run = [backend.state, *(backend.step(target) for target in targets[:3])]
        backend.reset(STILL, np.array([True, False, False, True]))
        runs.append([*run, backend.state, *(backend.step(target) for target in targets[3:])])
        backend.close()
    assert (runs[0][-1].parameters is not None) == bool(settings)
    for run in runs[1:]:
        for state, expected in zip(run, runs[0], strict=True):
            assert_same_state(state, expected)


def test_every_start_method_gives_the_same_numbers(mara: RobotModel, start_method: str) -> None:
    alone, spread = _make(mara, 1), _make(mara, 2)
    assert isinstance(spread, WorkerBackend)
    of_fork = " ".join(psutil.Process().cmdline())
    mark = of_fork if start_method == "fork" else f"multiprocessing.{start_method}"
    assert all(mark in " ".join(psutil.Process(p.pid).cmdline()) for p in spread.processes)
    q, target = uniform_q(mara, 4, seed=3), uniform_q(mara, 4, seed=4, furthest=2.3)
    for backend in (alone, spread):
        backend.reset(q)
    assert_same_state(spread.step(target), alone.step(target))
    spread.close()
    assert not any(process.is_alive() for process in spread.processes)


@pytest.mark.parametrize(("before", "after"), [(1, 2), (2, 1), (2, 4)])
def test_a_snapshot_fits_any_number_of_processes(mara: RobotModel, before: int, after: int) -> None:
    first, second = (_make(mara, n, randomisation=RANDOM) for n in (before, after))
    first.begin_episodes(np.arange(4, dtype=np.uint64), np.ones(4, np.bool_))
    first.reset(uniform_q(mara, 4, seed=2))
    targets = np.random.default_rng(1).uniform(-1.5, 1.5, (6, 4, 6))
    for target in targets[:3]:
        first.step(target)
    second.restore(first.save())
    assert_same_state(second.state, first.state)
    for target in targets[3:]:
        assert_same_state(second.step(target), first.step(target))


def test_a_snapshot_of_another_number_of_arms_is_refused(mara: RobotModel) -> None:
    other = make_backend("dart", mara, 2, {"workers": 1})
    with pytest.raises(GymMaraError, match="the snapshot is of 2 arms; these are 4"):
        _make(mara, 2).restore(other.save())


def test_arms_that_cannot_be_shared_out_equally_are_refused(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="workers=3 must divide the number of arms, 4"):
        _make(mara, 3)


def test_by_default_there_is_a_process_for_each_core_that_can_have_an_equal_share(
    mara: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1}, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda pid, cores: None, raising=False)
    spread = make_backend("dart", mara, 4, {})
    assert isinstance(spread, WorkerBackend)
    assert len(spread.processes) == 2
    assert not isinstance(make_backend("dart", mara, 3, {}), WorkerBackend)


def test_workers_that_fill_all_cores_have_one_core_each(mara: RobotModel) -> None:
    if not hasattr(os, "sched_getaffinity"):
        return
    cores = sorted(os.sched_getaffinity(0))
    backend = WorkerBackend(FakeBackend, mara, len(cores), len(cores), {})
    assert [os.sched_getaffinity(p.pid or 0) for p in backend.processes] == [{c} for c in cores]
    assert sorted(os.sched_getaffinity(0)) == cores
    backend = WorkerBackend(FakeBackend, mara, len(cores) + 1, len(cores) + 1, {})
    assert all(os.sched_getaffinity(p.pid or 0) == set(cores) for p in backend.processes)


def test_bad_settings_are_refused_before_a_process_starts(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="physics_step"):
        _make(mara, 2, physics_step=0.003)


def test_an_error_in_a_worker_is_raised_as_itself_and_a_reset_recovers(mara: RobotModel) -> None:
    alone = _make(mara, 1)
    with closing(_make(mara, 2)) as backend:
        snapshot = backend.save()
        snapshot["qd"][2] = 1e200
        backend.restore(snapshot)
        with pytest.raises(SimulationDivergedError, match="of arm 2 diverged") as caught:
            backend.step(STILL)
        assert "in step" in str(caught.value.__cause__)
        for each in (alone, backend):
            each.reset(STILL)
        assert_same_state(backend.step(STILL + 0.2), alone.step(STILL + 0.2))


@pytest.mark.parametrize(
    ("asked", "kind", "message"),
    [
        (0.1, GymMaraError, "a target that nobody likes"),
        (0.2, ZeroDivisionError, "by nothing"),
        (0.3, RuntimeError, "_Unpicklable: .*a lambda within"),
    ],
)
def test_any_error_in_a_worker_comes_with_its_traceback(
    asked: float, kind: type[Exception], message: str
) -> None:
    with closing(_troubled()) as backend:
        with pytest.raises(kind, match=message) as caught:
            backend.step(_target(asked))
        assert "in step" in str(caught.value.__cause__)
        assert backend.step(_target(0.5)).q[2, 0] == 0.5


def test_a_result_that_does_not_pickle_is_an_error() -> None:
    with closing(_troubled()) as backend, pytest.raises(Exception, match=r"pickle|local object"):
        backend.save()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_that_dies_is_an_error_and_all_end(number: signal.Signals) -> None:
    backend = _troubled()
    victim = backend.processes[1]
    os.kill(victim.pid or 0, number)
    victim.join()
    with pytest.raises(WorkerDiedError, match="a worker process of the simulation died"):
        backend.step(STILL)
    assert not any(process.is_alive() for process in backend.processes)
    with pytest.raises(WorkerDiedError, match="have ended; make a new environment"):
        backend.step(STILL)
    backend.close()


def test_sigterm_ends_a_forked_worker_whatever_its_program_does_at_sigterm() -> None:
    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        backend = _troubled()
        victim = backend.processes[0]
        os.kill(victim.pid or 0, signal.SIGTERM)
        victim.join()
        assert victim.exitcode == -signal.SIGTERM, "and prints no traceback"
    finally:
        signal.signal(signal.SIGTERM, before)
    backend.close()


def test_a_worker_that_dies_within_a_step_is_noticed() -> None:
    backend = _troubled()
    threading.Timer(0.3, backend.processes[1].kill).start()
    start = time.monotonic()
    with pytest.raises(WorkerDiedError):
        backend.step(_target(0.4))
    assert time.monotonic() - start < 5.0
    assert not any(process.is_alive() for process in backend.processes)


def test_a_call_while_another_thread_steps_is_an_error_and_disturbs_nothing() -> None:
    backend = _troubled()
    ended: list[type[BaseException]] = []

    def step() -> None:
        try:
            backend.step(_target(0.4))
        except GymMaraError as error:
            ended.append(type(error))

    stepping = threading.Thread(target=step)
    stepping.start()
    while not backend._workers._in_use.locked():
        time.sleep(0.001)
    with pytest.raises(GymMaraError, match="another thread"):
        backend.step(STILL)
    assert not ended
    assert stepping.is_alive()
    for process in backend.processes:
        process.kill()
    stepping.join(10.0)
    assert ended == [WorkerDiedError]


def test_a_keyboard_interrupt_within_a_step_ends_the_workers() -> None:
    backend = _troubled()
    for process in backend.processes:
        os.kill(process.pid or 0, signal.SIGINT)  # workers ignore it
    backend.step(STILL)
    threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
    with pytest.raises(KeyboardInterrupt):
        backend.step(_target(0.4))
    assert not any(process.is_alive() for process in backend.processes)
    with pytest.raises(WorkerDiedError):
        backend.step(STILL)


def _close(only: list[WorkerBackend]) -> None:
    backend = only.pop()
    backend.close()
    backend.close()


def _collect(only: list[WorkerBackend]) -> None:
    backend = only.pop()
    backend.__dict__["itself"] = backend  # only the garbage collector can free it
    del backend
    gc.collect()


@pytest.mark.parametrize("end", [_close, _collect])
def test_closing_or_dropping_it_closes_the_blocks_and_ends_the_workers(
    tmp_path: Path, end: Callable[[list[WorkerBackend]], None]
) -> None:
    backend = _troubled({"closed": str(tmp_path / "closed")})
    (tmp_path / "closed").unlink()  # by the backend that was made to check the settings
    processes = backend.processes
    only = [backend]  # Python 3.10 keeps the arguments of a call until it returns
    del backend
    end(only)
    assert not any(process.is_alive() for process in processes)
    assert (tmp_path / "closed").exists()


def test_closing_does_not_wait_for_a_dead_worker() -> None:
    backend = _troubled()
    backend.processes[1].kill()
    start = time.monotonic()
    backend.close()
    assert time.monotonic() - start < 2.0


def _in_a_fork(function: Callable[[], None]) -> int:
    """The exit code of a forked process that calls a function; it must end within seconds."""
    process = multiprocessing.get_context("fork").Process(target=function)
    process.start()
    process.join(20.0)
    if process.exitcode is None:
        process.kill()
        process.join()
    return process.exitcode or 0


def test_a_forked_process_neither_uses_nor_ends_the_workers() -> None:
    backends = [_troubled()]

    def use_and_drop() -> None:
        with pytest.raises(
            GymMaraError, match="belong to the process that this one was forked from"
        ):
            backends[0].step(STILL)
        backends[0].close()
        backends.clear()
        gc.collect()
        _troubled().step(STILL)  # its own

    assert _in_a_fork(use_and_drop) == 0
    assert backends[0].step(_target(0.5)).q[2, 0] == 0.5


SCRIPT = """
import multiprocessing, os, sys, time
from gym_mara.backends import make_backend
from gym_mara.robot import RobotModel

def idle():
    time.sleep(60.0)

if __name__ == "__main__":
    multiprocessing.set_start_method(sys.argv[1])
    robot = RobotModel.load("mara")
    count = 2 if sys.argv[1] == "fork" else 1  # forked workers inherit the pipes of earlier ones
    backends = [make_backend("dart", robot, 4, {"workers": 2}) for _ in range(count)]
    pids = [process.pid for backend in backends for process in backend.processes]
    if sys.argv[2] == "fork":
        child = multiprocessing.get_context("fork").Process(target=idle)
        child.start()
        pids.append(child.pid)
    print(*pids, flush=True)
    if sys.argv[2] != "end":
        time.sleep(60.0)
"""


def _all_end(pids: list[int], seconds: float) -> bool:
    deadline = time.monotonic() + seconds
    while alive := [pid for pid in pids if psutil.pid_exists(pid)]:
        alive = [pid for pid in alive if psutil.Process(pid).status() != psutil.STATUS_ZOMBIE]
        if not alive or time.monotonic() > deadline:
            break
        time.sleep(0.02)
    return not alive


@pytest.mark.parametrize("method", START_METHODS)
def test_workers_end_when_their_parent_is_killed(method: str, tmp_path: Path) -> None:
    script = write(tmp_path / "script.py", SCRIPT)
    with started(str(script), method, "wait") as process:
        assert process.stdout is not None
        pids = [int(pid) for pid in process.stdout.readline().split()]
        assert len(pids) == (4 if method == "fork" else 2)
        process.kill()
        process.wait()
        assert _all_end(pids, 10.0)


def test_workers_end_although_a_process_forked_later_outlives_their_parent(tmp_path: Path) -> None:
    script = write(tmp_path / "script.py", SCRIPT)
    with started(str(script), "fork", "fork") as process:
        assert process.stdout is not None
        *pids, child = (int(pid) for pid in process.stdout.readline().split())
        process.kill()
        process.wait()
        assert _all_end(pids, 10.0)
        assert psutil.pid_exists(child)


def test_a_program_ends_with_its_workers_without_closing_them(tmp_path: Path) -> None:
    script = write(tmp_path / "script.py", SCRIPT)
    done = subprocess.run(
        [sys.executable, str(script), "fork", "end"], capture_output=True, text=True, timeout=60
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert _all_end([int(pid) for pid in done.stdout.split()], 0.0)


STEPPING = """
import multiprocessing, os, sys
import gymnasium, numpy, gym_mara

if __name__ == "__main__":
    os.dup2(os.open(sys.argv[2], os.O_CREAT | os.O_WRONLY), 2)
    multiprocessing.set_start_method(sys.argv[1])
    options = {"num_envs": 4, "backend": "dart", "workers": 2}
    envs = gymnasium.make_vec("gym_mara/MARA-v0", **options)
    envs.reset(seed=0)
    print(*(process.pid for process in envs.simulation.backend.processes), flush=True)
    while True:
        envs.step(numpy.zeros((4, 6)))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.parametrize("method", START_METHODS)
def test_a_program_that_is_ended_within_a_step_prints_no_error(
    method: str, number: signal.Signals, tmp_path: Path
) -> None:
    script, errors = write(tmp_path / "script.py", STEPPING), tmp_path / "stderr"
    with started(str(script), method, str(errors)) as process:
        assert process.stdout is not None
        pids = [int(pid) for pid in process.stdout.readline().split()]
        process.send_signal(number)
        assert process.wait(10.0) == -number
        assert _all_end(pids, 10.0)
    assert errors.read_text() == ""


def test_python_without_a_main_module_has_workers(tmp_path: Path) -> None:
    code, errors = STEPPING.replace("while True:", "for _ in range(2):"), tmp_path / "stderr"
    command = [sys.executable, "-c", code, "spawn", str(errors)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, errors.read_text()) == (0, "")


UNGUARDED = """
import multiprocessing, os
os.sched_getaffinity = lambda pid: {0, 1}
os.sched_setaffinity = lambda pid, cores: None
from gym_mara.backends import make_backend
from gym_mara.robot import RobotModel
multiprocessing.set_start_method("spawn", force=True)
make_backend("dart", RobotModel.load("mara"), 4, {})
"""


@pytest.mark.parametrize("options", ["{}", "{'workers': 2}"])
def test_a_program_whose_main_module_has_no_guard_ends_with_an_error(
    tmp_path: Path, options: str
) -> None:
    """Where processes are spawned they import the main module, and would all run the program."""
    script = write(tmp_path / "script.py", UNGUARDED.replace("{})", f"{options})"))
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=60)
    assert done.returncode != 0
    assert "put what the program does under `if __name__ == '__main__':`" in done.stderr
    assert "WorkerDiedError" in done.stderr


class UnmakableBackend(FakeBackend):
    """Cannot be made for two arms."""

    def __init__(self, robot: RobotModel, num_envs: int) -> None:
        if num_envs == 2:
            raise FileNotFoundError("no licence")
        super().__init__(robot, num_envs)


def test_an_error_while_a_block_is_made_is_raised_as_itself(mara: RobotModel) -> None:
    with pytest.raises(FileNotFoundError, match="no licence") as caught:
        WorkerBackend(UnmakableBackend, mara, 4, 2, {})
    assert "in __init__" in str(caught.value.__cause__)
    del caught
    assert not multiprocessing.active_children()
