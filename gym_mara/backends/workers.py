"""A backend spread over worker processes, for engines that hold Python's lock while they step."""

from __future__ import annotations

import functools
import multiprocessing
import sys
from collections.abc import Mapping
from dataclasses import fields
from multiprocessing.process import BaseProcess
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.base import Backend
from gym_mara.backends.processes import Workers, cores
from gym_mara.errors import GymMaraError, whole_number
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.types import Floats, Mask


def choose_workers(num_envs: int, workers: int | None) -> int:
    """The number of processes for N arms: the one asked for, else the largest that divides N and has a core for each.

    Unless asked for it is one in a process started by multiprocessing or Ray: the program that started it has already
    shared out the cores.

    Raises:
        GymMaraError: the arms cannot be shared out equally, or the program's main module lacks its guard.
    """
    importing = getattr(multiprocessing.current_process(), "_inheriting", False)
    if importing and workers != 1:
        # A new process is importing the main module: without this error it would run the whole program again.
        raise GymMaraError(
            "the main module of the program makes an environment while a worker process imports it; "
            "put what the program does under `if __name__ == '__main__':`, or give workers=1"
        )
    if workers is not None:
        workers = whole_number(
            "workers",
            workers,
            at_most=max(16, 4 * len(cores())),
            reason="each is a process, and more of them only take memory",
        )
        if num_envs % workers:
            fitting = [str(n) for n in range(1, num_envs + 1) if num_envs % n == 0]
            raise GymMaraError(
                f"workers={workers} must divide the number of arms, {num_envs}: {', '.join(fitting)}"
            )
        return workers
    if in_worker():
        return 1
    return max(n for n in range(1, len(cores()) + 1) if num_envs % n == 0)


def in_worker() -> bool:
    """Whether multiprocessing or Ray has started this process."""
    ray = sys.modules.get("ray")
    return multiprocessing.parent_process() is not None or (
        ray is not None
        and ray.is_initialized()
        and ray.get_runtime_context().get_task_id() is not None
    )


class WorkerBackend(Backend):
    """N arms in equal blocks, each block a backend in its own worker process.

    The numbers are those of one process, to the bit, and an error in a block is raised here as itself.

    Args:
        backend: the class of the backend.
        robot: the arm.
        num_envs: N.
        workers: the number of processes.
        settings: of the backend.

    Raises:
        GymMaraError: a setting is out of its range.
        WorkerDiedError: from any method: the workers have ended.
    """

    def __init__(
        self,
        backend: type[Backend],
        robot: RobotModel,
        num_envs: int,
        workers: int,
        settings: dict[str, Any],
    ) -> None:
        self._arguments = (backend, robot, num_envs, workers, settings)
        example = backend(robot, 1, **settings)  # checks the settings before a process is started
        super().__init__(robot, num_envs, control_period=example.control_period)
        self.joint_velocity = example.joint_velocity
        self.random, self.teleports = example.random, example.teleports
        self.overshoot, self.servo_gain = example.overshoot, example.servo_gain
        example.close()
        size = num_envs // workers
        self._rows = [slice(start, start + size) for start in range(0, num_envs, size)]
        self._workers = Workers(functools.partial(backend, robot, size, **settings), workers)
        self._workers.call("__setattr__", [("first_arm", rows.start) for rows in self._rows])
        self._states: list[SimState] | None = None

    @property
    def processes(self) -> list[BaseProcess]:
        """The worker processes."""
        return self._workers.processes

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: Mask) -> None:
        self._call("begin_episodes", seeds, mask)

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        self._call("reset", q, mask)

    def step(self, q_target: Floats) -> SimState:
        self._states = self._call("step", q_target)
        return self.state

    @property
    def state(self) -> SimState:
        if self._states is None:
            self._states = self._call("state")
        blocks = self._states
        return SimState(
            **{f.name: _joined([getattr(b, f.name) for b in blocks]) for f in fields(SimState)}
        )

    def save(self) -> dict[str, Any]:
        snapshot: dict[str, Any] = _joined(self._call("save"))
        return snapshot

    def restore(self, snapshot: dict[str, Any]) -> None:
        count = _count(snapshot)
        if count != self.num_envs:
            raise GymMaraError(f"the snapshot is of {count} arms; these are {self.num_envs}")
        self._call("restore", snapshot)

    def close(self) -> None:
        self._workers.close()

    def _call(self, name: str, *arguments: Any) -> list[Any]:
        """Call a method of every block with its own rows of the arguments; the results, block by block."""
        self._states = None
        parts = [[_part(argument, rows) for argument in arguments] for rows in self._rows]
        return self._workers.call(name, parts)

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self._arguments, self.save())


def _restored(arguments: tuple[Any, ...], snapshot: dict[str, Any]) -> WorkerBackend:
    backend = WorkerBackend(*arguments)
    backend.restore(snapshot)
    return backend


# What is split and joined has a row for each arm: an array, a list, a tuple, or a dict of such; or it is None.


def _part(value: Any, rows: slice) -> Any:
    if isinstance(value, Mapping):
        return {key: _part(values, rows) for key, values in value.items()}
    return None if value is None else value[rows]


def _joined(parts: list[Any]) -> Any:
    first = parts[0]
    if first is None:
        return None
    if isinstance(first, Mapping):
        return {key: _joined([part[key] for part in parts]) for key in first}
    if isinstance(first, np.ndarray):
        return np.concatenate(parts)
    return type(first)(row for part in parts for row in part)


def _count(value: Any) -> int:
    while isinstance(value, Mapping):
        value = next(iter(value.values()))
    return len(value)
