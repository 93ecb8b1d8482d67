"""The threads of the backend "mujoco": how many there are, that results do not depend on it, and that processes end."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gym_mara.backends.mujoco import threads as of_backend
from gym_mara.backends.mujoco.backend import MujocoBackend
from gym_mara.backends.mujoco.threads import choose_threads
from gym_mara.envs import MaraVectorEnv
from gym_mara.robot import RobotModel
from gym_mara.testing import COPIES, arms_of, assert_same_state, uniform_q

RANDOM = {"mass": (0.8, 1.2), "joint_friction": (0.0, 0.5), "latency": (0.0, 0.03)}
# A program that uses threads, forks, uses them in both processes, and ends with a backend that is open.
FORKING = """
import os
import numpy as np
from gym_mara.backends.mujoco import MujocoBackend
from gym_mara.robot import RobotModel

backend, target = MujocoBackend(RobotModel.load("mara"), 4, threads=2), np.full((4, 6), 0.3)
backend.step(target)
child = os.fork()
q = backend.step(target).q
os.write(1, f"{q.tolist()}\\n".encode())  # at once: both processes write at the same time
if child:
    assert os.waitpid(child, 0)[1] == 0
"""


def _threads() -> int:
    """The number of threads of this process."""
    return len(os.listdir("/proc/self/task"))


def _steps(backend: MujocoBackend) -> list[Any]:
    """The states of arms that move, and partly collide."""
    count = backend.num_envs
    backend.begin_episodes(np.arange(count, dtype=np.uint64), np.ones(count, np.bool_))
    backend.reset(uniform_q(backend.robot, count, seed=1))
    targets = uniform_q(backend.robot, 8 * count, seed=2, furthest=2.3)
    return [backend.step(target) for target in np.split(targets, 8)]


@pytest.mark.parametrize("settings", [{}, {"randomisation": RANDOM}], ids=["plain", "random"])
def test_results_do_not_depend_on_the_number_of_threads(
    mara: RobotModel, settings: dict[str, Any]
) -> None:
    expected = _steps(MujocoBackend(mara, 25, threads=1, **settings))
    assert any(state.collided.any() for state in expected)
    for threads in (2, 3):
        states = _steps(MujocoBackend(mara, 25, threads=threads, **settings))
        for state, other in zip(states, expected, strict=True):
            assert_same_state(state, other)


def test_many_arms_move_as_each_alone_to_the_bit(mara: RobotModel) -> None:
    q, targets = uniform_q(mara, 12, seed=1), uniform_q(mara, 12, seed=2, furthest=2.3)
    together = MujocoBackend(mara, 12, threads=2)
    together.reset(q)
    states = [together.step(targets) for _ in range(10)]
    for arm in range(12):
        alone, one = MujocoBackend(mara, 1), slice(arm, arm + 1)
        alone.reset(q[one])
        for state in states:
            assert_same_state(alone.step(targets[one]), arms_of(state, one))


def test_there_is_a_thread_for_each_core_but_not_more_than_arms(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(of_backend, "cores", lambda: list(range(6)))
    chosen = [choose_threads(arms, None) for arms in (1, 4, 64)]
    assert chosen == [1, 4, 6]
    assert choose_threads(64, 3) == 3
    assert choose_threads(2, 3) == 2


def _chosen_in_a_worker(queue: Any) -> None:
    queue.put(choose_threads(64, None))


@pytest.mark.parametrize("method", ["fork", "spawn"])
def test_a_worker_process_has_one_thread_unless_asked_for_more(
    monkeypatch: pytest.MonkeyPatch, method: str
) -> None:
    context: Any = multiprocessing.get_context(method)
    queue = context.SimpleQueue()
    process = context.Process(target=_chosen_in_a_worker, args=(queue,))
    process.start()
    process.join(60.0)
    assert process.exitcode == 0
    assert queue.get() == 1


@pytest.mark.skipif(not os.path.isdir("/proc/self/task"), reason="counts threads on Linux")
def test_one_arm_runs_on_the_calling_thread_and_close_ends_the_others(mara: RobotModel) -> None:
    before = _threads()
    MujocoBackend(mara, 1, threads=4)
    MujocoBackend(mara, 8, threads=1).step(np.zeros((8, 6)))
    assert _threads() == before
    backend = MujocoBackend(mara, 8, threads=4)
    backend.step(np.zeros((8, 6)))
    assert _threads() == before + 4
    backend.close()
    assert _threads() == before
    backend.close()


@pytest.mark.parametrize("duplicate", COPIES)
def test_a_copy_has_threads_of_its_own(
    mara: RobotModel, duplicate: Callable[[MujocoBackend], MujocoBackend]
) -> None:
    backend = MujocoBackend(mara, 8, threads=3)
    backend.step(np.zeros((8, 6)))
    other = duplicate(backend)
    backend.close()
    assert other._settings["threads"] == 3
    assert other.step(np.full((8, 6), 0.1)).q.all()


def test_backends_step_in_several_threads_of_python(mara: RobotModel) -> None:
    """MuJoCo does not hold Python's lock, so several backends step at the same time."""
    backends = [MujocoBackend(mara, 16, threads=2) for _ in range(3)]
    results: dict[int, Any] = {}

    def run(index: int) -> None:
        results[index] = _steps(backends[index])

    started = [threading.Thread(target=run, args=(index,)) for index in range(3)]
    for thread in started:
        thread.start()
    for thread in started:
        thread.join()
    for index in (1, 2):
        for state, other in zip(results[index], results[0], strict=True):
            assert_same_state(state, other)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_forked_process_starts_threads_of_its_own_and_ends() -> None:
    done = subprocess.run(
        [sys.executable, "-c", FORKING], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    first, second = done.stdout.splitlines()
    assert first == second


def test_a_vector_env_needs_no_worker_processes() -> None:
    envs = MaraVectorEnv(4, backend="mujoco", threads=2)
    envs.reset(seed=0)
    envs.step(np.zeros((4, 6)))
    assert multiprocessing.active_children() == []
    envs.close()
