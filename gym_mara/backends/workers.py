"""A backend spread over worker processes, for engines that hold Python's lock while they step."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import sys
import traceback
import weakref
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import fields
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.base import Backend
from gym_mara.errors import GymMaraError, whole_number
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.types import Floats, Mask

_FIELDS = tuple(field.name for field in fields(SimState))
_GRACE = 5.0
"""How long a worker that was asked to end may take before it is killed, s."""


class WorkerDiedError(GymMaraError):
    """The worker processes have ended: one was killed or ran out of memory, or a step was interrupted."""


def choose_workers(num_envs: int, workers: int | None) -> int:
    """The number of processes that N arms are spread over: the one asked for, or as many as there are cores.

    Without a wish it is one in a process that was started by multiprocessing or Ray: the program that started it has
    already shared out the cores.

    Raises:
        GymMaraError: the arms cannot be shared out equally, or the program's main module lacks its guard.
    """
    if workers is not None:
        workers = whole_number("workers", workers)
        if num_envs % workers:
            fitting = [str(n) for n in range(1, num_envs + 1) if num_envs % n == 0]
            raise GymMaraError(
                f"workers={workers} must divide the number of arms, {num_envs}: {', '.join(fitting)}"
            )
        return workers
    if getattr(multiprocessing.current_process(), "_inheriting", False):
        raise GymMaraError(
            "a new process imports the main module of the program, which makes an environment at once; "
            "put what the program does under `if __name__ == '__main__':`, or give workers=1"
        )
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
    """N arms in equal blocks, each block a backend in its own worker process.

    The numbers are those of one process, to the bit, and an error in a block is raised here. A worker ends when this
    backend is closed or garbage-collected, and when the process that made it ends, however it ends.

    Args:
        backend: the class of the backend.
        robot: the arm.
        num_envs: N.
        workers: the number of processes.
        settings: of the backend.

    Raises:
        GymMaraError: a setting is out of its range.
        WorkerDiedError: a worker could not be started; or, from any method, the workers have ended.
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
        example = backend(robot, 1, **settings)
        super().__init__(robot, num_envs, control_period=example.control_period)
        self.joint_velocity = example.joint_velocity
        self.random, self.teleports = example.random, example.teleports
        example.close()
        self._states: list[SimState] | None = None
        self._pipes: list[Connection] = []
        self.processes: list[BaseProcess] = []
        """The workers."""
        self._owner = os.getpid()
        self._end = weakref.finalize(self, _end, self._owner, self._pipes, self.processes)
        # One core for each worker where they fill all cores: a scheduler tends to put several on one.
        numbers: list[int | None] = [*cores()]
        if len(numbers) != workers or not hasattr(os, "sched_setaffinity"):
            numbers = [None] * workers
        with self._all_or_none():
            for core in numbers:
                self._start(core, backend, robot, num_envs // workers, settings)
        try:
            self._call("make")
        except BaseException:
            self._kill()
            raise

    def _start(self, core: int | None, *block: Any) -> None:
        pipe, its_end = multiprocessing.Pipe()
        self._pipes.append(pipe)
        _parents_ends.add(pipe)
        process = multiprocessing.Process(target=_work, args=(its_end, core, *block), daemon=True)
        process.start()
        self.processes.append(process)
        its_end.close()

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
        return SimState(**{f: _joined([getattr(b, f) for b in blocks]) for f in _FIELDS})

    def save(self) -> dict[str, Any]:
        snapshot: dict[str, Any] = _joined(self._call("save"))
        return snapshot

    def restore(self, snapshot: dict[str, Any]) -> None:
        count = _count(snapshot)
        if count != self.num_envs:
            raise GymMaraError(f"the snapshot is of {count} arms; these are {self.num_envs}")
        self._call("restore", snapshot)

    def close(self) -> None:
        self._end()

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self._arguments, self.save())

    def _call(self, method: str, *arguments: Any) -> list[Any]:
        """Call a method of every block with the rows of the arguments that are its own; the results, block by block.

        Raises:
            WorkerDiedError: a worker has ended; then all have.
            Exception: the first that a block raised; its cause holds the traceback. The workers go on.
        """
        if os.getpid() != self._owner:
            raise GymMaraError(
                "these arms are in worker processes of another process; make the environment in the process that uses it"
            )
        if not self._end.alive:
            raise WorkerDiedError("the worker processes have ended; make the environment anew")
        self._states = None
        size = self.num_envs // len(self._pipes)
        with self._all_or_none():
            for index, pipe in enumerate(self._pipes):
                rows = slice(index * size, (index + 1) * size)
                pipe.send((method, [_rows(argument, rows) for argument in arguments]))
            replies = [pickle.loads(pipe.recv_bytes()) for pipe in self._pipes]
        for reply in replies:
            if isinstance(reply, _Failure):
                raise reply.error from _RemoteTraceback(reply.traceback)
        return replies

    @contextmanager
    def _all_or_none(self) -> Iterator[None]:
        """End all workers where an exchange with them fails: what the others have sent would be taken for a later reply."""
        try:
            yield
        except (EOFError, OSError) as error:
            self._kill()
            raise WorkerDiedError(
                "a worker process of the simulation died (killed, or out of memory?); make the environment anew, "
                "with fewer arms or workers if memory was short"
            ) from error
        except BaseException:
            self._kill()
            raise

    def _kill(self) -> None:
        for process in self.processes:
            process.kill()
        self._end()


def _end(owner: int, pipes: list[Connection], processes: list[BaseProcess]) -> None:
    """Ask the workers to end, and kill those that do not."""
    if os.getpid() != owner:
        return  # a copy of the backend in a forked process
    for pipe in pipes:
        with suppress(OSError):
            pipe.send(None)
        pipe.close()
    for process in processes:
        process.join(_GRACE)
        if process.exitcode is None:
            process.kill()
            process.join()


# A worker ends when the last copy of the parent's end of its pipe is closed. A fork makes copies: its child closes them.
_parents_ends: weakref.WeakSet[Connection] = weakref.WeakSet()


def _close_copies() -> None:
    for pipe in _parents_ends:
        pipe.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_copies)


class _Failure(NamedTuple):
    error: Exception
    traceback: str


class _RemoteTraceback(Exception):  # noqa: N818 - it is shown as the cause of an error
    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def _work(
    pipe: Connection,
    core: int | None,
    backend: type[Backend],
    robot: RobotModel,
    count: int,
    settings: dict[str, Any],
) -> None:
    """What a worker does: answer each call of a method of its block, until there are no more."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C goes to every process: the parent ends the workers
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # not the parent's handler
    if core is not None:
        os.sched_setaffinity(0, {core})
    block: Any = None
    with suppress(EOFError, OSError):  # the parent has ended
        while request := pipe.recv():
            method, arguments = request
            try:
                if method == "make":
                    block, result = backend(robot, count, **settings), None
                elif method == "state":
                    result = block.state
                else:
                    result = getattr(block, method)(*arguments)
                reply = pickle.dumps(result, pickle.HIGHEST_PROTOCOL)
            except Exception as error:
                reply = _failure(error)
            pipe.send_bytes(reply)
    if block is not None:
        block.close()


def _failure(error: Exception) -> bytes:
    """An error as a message; where it does not pickle, one of its name and text."""
    trace = "".join(traceback.format_exception(type(error), error, error.__traceback__))
    try:
        message = pickle.dumps(_Failure(error, trace))
        pickle.loads(message)
    except Exception:
        message = pickle.dumps(_Failure(RuntimeError(f"{type(error).__name__}: {error}"), trace))
    return message


def _restored(arguments: tuple[Any, ...], snapshot: dict[str, Any]) -> WorkerBackend:
    backend = WorkerBackend(*arguments)
    backend.restore(snapshot)
    return backend


# Values with a row for each arm: arrays, lists and tuples, dicts of such; and None.


def _joined(blocks: list[Any]) -> Any:
    first = blocks[0]
    if first is None:
        return None
    if isinstance(first, Mapping):
        return {key: _joined([block[key] for block in blocks]) for key in first}
    if isinstance(first, np.ndarray):
        return np.concatenate(blocks)
    return type(first)(row for block in blocks for row in block)


def _rows(value: Any, rows: slice) -> Any:
    if value is None:
        return None
    if isinstance(value, Mapping):
        return {key: _rows(values, rows) for key, values in value.items()}
    return value[rows]


def _count(value: Any) -> int:
    while isinstance(value, Mapping):
        value = next(iter(value.values()))
    return len(value)
