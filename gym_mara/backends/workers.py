"""A backend spread over processes, for engines that hold Python's lock while they step."""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AsyncVectorEnv
from numpy.typing import NDArray

from gym_mara.backends.base import Backend
from gym_mara.errors import GymMaraError, whole_number
from gym_mara.robot import RobotModel
from gym_mara.state import SimState

Floats = NDArray[np.float64]


class WorkerDiedError(GymMaraError):
    """A worker process is gone: killed, or out of memory."""


def choose_workers(num_envs: int, workers: int | None) -> int:
    """How many processes N arms are spread over: those that were asked for, or as many as there are cores.

    In a process that multiprocessing or Ray has begun it is one: whoever began it shares out the cores.

    Raises:
        GymMaraError: the arms cannot be shared out equally.
    """
    if workers is not None:
        workers = whole_number("workers", workers)
        if num_envs % workers:
            fitting = [str(n) for n in range(1, num_envs + 1) if num_envs % n == 0]
            raise GymMaraError(
                f"workers={workers} must divide the number of arms, {num_envs}: {', '.join(fitting)}"
            )
        return workers
    if multiprocessing.parent_process() is not None or _in_ray_worker():
        return 1
    return max(n for n in range(1, len(cores()) + 1) if num_envs % n == 0)


def _in_ray_worker() -> bool:
    ray = sys.modules.get("ray")
    return (
        ray is not None
        and ray.is_initialized()
        and ray.get_runtime_context().get_task_id() is not None
    )


def cores() -> list[int]:
    """The numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


class WorkerBackend(Backend):
    """N arms in as many equal blocks as there are workers, each a backend in a process of its own.

    Gymnasium's AsyncVectorEnv runs the processes and shares the memory in which the states come back. The numbers are
    those of one process, to the bit.

    Args:
        backend: the class of the backend.
        robot: the arm.
        num_envs: N.
        workers: how many processes.
        settings: of the backend.
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
        pilot = backend(robot, 1, **settings)  # tells what the settings come to
        super().__init__(robot, num_envs, control_period=pilot.control_period)
        self.joint_velocity, self.random = pilot.joint_velocity, pilot.random
        pilot.close()
        self._sizes = (robot.num_joints, robot.num_joints, 3, 4, 3, 1, 1, 1, 1)
        size = num_envs // workers

        here, numbers = os.getpid(), cores()

        def block(index: int) -> Callable[[], _Block]:
            def make() -> _Block:
                # One core each where they fill them all: the scheduler wakes several on one, its waker's.
                if (
                    os.getpid() != here
                    and len(numbers) == workers
                    and hasattr(os, "sched_setaffinity")
                ):
                    os.sched_setaffinity(0, {numbers[index]})
                return _Block(backend(robot, size, **settings), index, sum(self._sizes))

            return make

        self._pool = AsyncVectorEnv([block(index) for index in range(workers)], copy=False)
        self._tell("nothing")

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: NDArray[np.bool_]) -> None:
        self._tell("begin_episodes", seeds, mask)

    def reset(self, q: Floats, mask: NDArray[np.bool_] | None = None) -> None:
        self._tell("reset", q, np.ones(self.num_envs, np.bool_) if mask is None else mask)

    def step(self, q_target: Floats) -> SimState:
        actions = q_target.reshape(self._pool.num_envs, -1, self.robot.num_joints)
        packed, _, _, _, info = self._guarded(lambda: self._pool.step(actions))
        self._take(packed, info)
        return self.state

    @property
    def state(self) -> SimState:
        return SimState(**self._unpacked())

    @property
    def sensor_noise(self) -> Floats | None:
        noise = self._columns()[-1][:, 0]
        return None if np.isnan(noise).any() else noise.copy()

    def report(self) -> dict[str, NDArray[Any]]:
        return {key: np.concatenate([r[key] for r in self._reports]) for key in self._reports[0]}

    def save(self) -> dict[str, Any]:
        blocks = self._guarded(lambda: self._pool.call("save"))
        return {key: _joined([block[key] for block in blocks]) for key in blocks[0]}

    def restore(self, snapshot: dict[str, Any]) -> None:
        count = len(next(iter(snapshot.values())))
        if count != self.num_envs:
            raise GymMaraError(f"the snapshot is of {count} arms; these are {self.num_envs}")
        size = count // self._pool.num_envs
        starts = range(0, count, size)
        blocks = [{key: v[start : start + size] for key, v in snapshot.items()} for start in starts]
        self._tell("restore", tuple(blocks))

    @property
    def processes(self) -> list[Any]:
        """The workers, as multiprocessing knows them."""
        return list(self._pool.processes)

    def close(self) -> None:
        if not self._pool.closed:
            with suppress(WorkerDiedError):
                self._guarded(self._pool.close)

    def _tell(self, method: str, *values: Any) -> None:
        """Have every block call a method, with its part of the values, and take the states after it."""
        parts = [v if isinstance(v, tuple) else np.split(v, self._pool.num_envs) for v in values]
        options = {"method": method, "parts": parts}
        self._take(*self._guarded(lambda: self._pool.reset(options=options)))

    def _take(self, packed: Floats, info: dict[str, Any]) -> None:
        self._packed = packed.reshape(self.num_envs, -1).copy()
        self._reports = [report for (report,) in info["report"]]
        diverged = self._columns()[-2][:, 0] != 0.0
        self.diverged = diverged if diverged.any() else None

    def _columns(self) -> list[Floats]:
        return np.split(self._packed, np.cumsum(self._sizes)[:-1], axis=1)

    def _unpacked(self) -> dict[str, Any]:
        columns = [column.copy() for column in self._columns()[: len(_FIELDS)]]
        state: dict[str, Any] = dict(zip(_FIELDS, columns, strict=True))
        state["collided"] = state["collided"][:, 0] != 0.0
        state["time"] = state["time"][:, 0]
        return state

    def _guarded(self, exchange: Callable[[], Any]) -> Any:
        """Exchange something with the workers; when one fails, none is left behind."""
        try:
            return exchange()
        except (EOFError, ConnectionError) as error:
            self._stop()
            raise WorkerDiedError(
                "a worker process of the simulation died (killed, or out of memory?); make the environment anew, "
                "with fewer arms or workers if memory was short"
            ) from error
        except BaseException:
            self._stop()
            raise

    def _stop(self) -> None:
        for process in self._pool.processes:
            process.terminate()
            process.join()
        self._pool.closed = True

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self._arguments, self.save())


def _restored(arguments: tuple[Any, ...], snapshot: dict[str, Any]) -> WorkerBackend:
    backend = WorkerBackend(*arguments)
    backend.restore(snapshot)
    return backend


def _joined(parts: list[Any]) -> Any:
    """The rows of all blocks, of arrays or of lists."""
    if isinstance(parts[0], list):
        return [row for part in parts for row in part]
    return np.concatenate(parts)


# The fields of a state in the order in which they are packed; what diverged and the sensors' noise follow.
_FIELDS = tuple(field.name for field in fields(SimState))


class _Block(gymnasium.Env[Floats, Floats]):
    """One worker's backend in the form that AsyncVectorEnv runs: its observation is the state, packed row by row.

    Whatever else is asked of the backend goes through reset(), as only reset() and step() use the shared memory.
    """

    def __init__(self, backend: Backend, index: int, width: int) -> None:
        self.backend, self._index = backend, index
        count = backend.num_envs
        self.observation_space = Box(-np.inf, np.inf, (count, width), np.float64)
        self.action_space = Box(-np.inf, np.inf, (count, backend.robot.num_joints), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        assert options is not None
        if options["method"] != "nothing":
            getattr(self.backend, options["method"])(*(p[self._index] for p in options["parts"]))
        return self._packed(self.backend.state), self._info()

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        return self._packed(self.backend.step(action)), 0.0, False, False, self._info()

    def save(self) -> dict[str, Any]:
        """The backend's snapshot."""
        return self.backend.save()

    def _packed(self, state: SimState) -> Floats:
        count, none = self.backend.num_envs, np.full(self.backend.num_envs, np.nan)
        diverged, noise = self.backend.diverged, self.backend.sensor_noise
        columns = [getattr(state, name) for name in _FIELDS]
        columns += [np.zeros(count) if diverged is None else diverged]
        columns += [none if noise is None else noise]
        return np.concatenate([c.reshape(count, -1) for c in columns], axis=1, dtype=np.float64)

    def _info(self) -> dict[str, Any]:
        return {"report": (self.backend.report(),)}  # in a tuple AsyncVectorEnv leaves it alone

    def close(self) -> None:
        self.backend.close()
