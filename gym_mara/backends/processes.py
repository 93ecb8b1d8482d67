"""Objects in worker processes, whose methods are called through pipes."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import traceback
import weakref
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NamedTuple

from gym_mara.errors import GymMaraError

_GRACE = 5.0
"""How long a worker that was asked to end may take before it is killed, s."""


class WorkerDiedError(GymMaraError):
    """The worker processes have ended: one was killed or ran out of memory, or a call was interrupted."""


class Workers:
    """Several worker processes with one object each.

    They end when this is closed or garbage-collected, and when the process that started them ends, even if it is killed.
    They ignore SIGINT: Ctrl-C interrupts the call, and that ends them.

    Args:
        make: makes the object in a worker; where processes are not forked it must pickle.
        count: the number of workers.

    Raises:
        WorkerDiedError: a worker could not start.
        Exception: what `make` raised.
    """

    def __init__(self, make: Callable[[], Any], count: int) -> None:
        self._pipes: list[Connection] = []
        self.processes: list[BaseProcess] = []
        self._owner = os.getpid()
        self._in_use = threading.Lock()
        self._end = weakref.finalize(self, _end, self._owner, self._pipes, self.processes)
        with self._killed_on_failure():
            for core in _own_cores(count):
                pipe, its_end = multiprocessing.Pipe()
                self._pipes.append(pipe)
                _ends_of_parent.add(pipe)
                process = multiprocessing.Process(
                    target=_work, args=(its_end, make, core), daemon=True
                )
                process.start()
                self.processes.append(process)
                its_end.close()
            replies = self._replies()
        try:
            _check(replies)
        except BaseException:
            self.close()
            raise

    def call(self, name: str, arguments: Sequence[Sequence[Any]]) -> list[Any]:
        """Call a method of every object, or read an attribute.

        Args:
            name: of the method or attribute.
            arguments: of each worker.

        Returns:
            The results, worker by worker.

        Raises:
            GymMaraError: another thread, or the process that this one was forked from, uses the workers.
            WorkerDiedError: a worker has ended; then all are ended.
            Exception: the first that an object raised, with its traceback as the cause. The workers continue.
        """
        if os.getpid() != self._owner:
            raise GymMaraError(
                "the worker processes belong to the process that this one was forked from; make the environment here"
            )
        if not self._end.alive:
            raise WorkerDiedError("the worker processes have ended; make a new environment")
        if not self._in_use.acquire(blocking=False):  # it would take replies of the other thread
            raise GymMaraError("another thread is using this environment: make one for each thread")
        try:
            with self._killed_on_failure():
                for pipe, its_arguments in zip(self._pipes, arguments, strict=True):
                    pipe.send((name, its_arguments))
                replies = self._replies()
        finally:
            self._in_use.release()
        _check(replies)
        return replies

    def close(self) -> None:
        """End the workers; closing twice does no harm."""
        self._end()

    def _replies(self) -> list[Any]:
        return [pickle.loads(pipe.recv_bytes()) for pipe in self._pipes]

    @contextmanager
    def _killed_on_failure(self) -> Iterator[None]:
        """Kill all workers where an exchange breaks off: later replies would be taken for those of the next call."""
        try:
            yield
        except BaseException as error:
            for process in self.processes:
                process.kill()
            self.close()
            if isinstance(error, (EOFError, OSError)):
                raise WorkerDiedError(
                    "a worker process of the simulation died (killed, or out of memory?); make a new environment, "
                    "with fewer arms or workers if memory was short. If it printed an error, correct that first"
                ) from error
            raise


def cores() -> list[int]:
    """The numbers of the cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return sorted(os.sched_getaffinity(0))
    return list(range(os.cpu_count() or 1))


def _own_cores(count: int) -> list[int] | list[None]:
    """A core for each worker where they fill all cores: a scheduler tends to put several on one. None elsewhere."""
    if len(cores()) == count and hasattr(os, "sched_setaffinity"):
        return cores()
    return [None] * count


def _end(owner: int, pipes: list[Connection], processes: list[BaseProcess]) -> None:
    """Ask the workers to end, and kill those that do not."""
    if os.getpid() != owner:
        return  # this is a copy in a forked process
    for pipe in pipes:
        with suppress(OSError):
            pipe.send(None)
        pipe.close()
    for process in processes:
        process.join(_GRACE)
        if process.exitcode is None:
            process.kill()
            process.join()


# A worker sees that its parent has ended when no process holds the parent's end of its pipe any more. A forked process
# inherits a copy of that end, and closes it.
_ends_of_parent: weakref.WeakSet[Connection] = weakref.WeakSet()


def _close_inherited() -> None:
    for pipe in _ends_of_parent:
        pipe.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_close_inherited)


def _work(pipe: Connection, make: Callable[[], Any], core: int | None) -> None:
    """What a worker does: make its object, then answer calls until there are no more."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # not the handler of a forked parent
    if core is not None:
        os.sched_setaffinity(0, {core})
    made: list[Any] = []

    def answer(name: str, arguments: Sequence[Any]) -> Any:
        value = getattr(made[0], name)
        return value(*arguments) if callable(value) else value

    with suppress(EOFError, OSError):  # the parent has ended
        pipe.send_bytes(_reply(lambda: made.append(make())))
        while request := pipe.recv():
            pipe.send_bytes(_reply(answer, *request))
    if made:
        made[0].close()


class _Failure(NamedTuple):
    error: Exception
    traceback: str


class _RemoteTraceback(Exception):  # noqa: N818 - only a cause
    def __str__(self) -> str:
        return f"\n{self.args[0]}"


def _reply(function: Callable[..., Any], *arguments: Any) -> bytes:
    """What a function returns, or the error that it raises, as a message."""
    try:
        return pickle.dumps(function(*arguments), pickle.HIGHEST_PROTOCOL)
    except Exception as error:
        trace = "".join(traceback.format_exception(type(error), error, error.__traceback__))
        try:
            message = pickle.dumps(_Failure(error, trace))
            pickle.loads(message)
        except Exception:  # an error that does not pickle: its name and text
            named = RuntimeError(f"{type(error).__name__}: {error}")
            message = pickle.dumps(_Failure(named, trace))
        return message


def _check(replies: list[Any]) -> None:
    for reply in replies:
        if isinstance(reply, _Failure):
            raise reply.error from _RemoteTraceback(reply.traceback)
