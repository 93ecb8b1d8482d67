"""Tasks in processes of their own: what they say is heard, one that dies is told, an interrupt leaves none behind."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any

from gym_mara.errors import GymMaraError, whole_number

Say = Callable[[Any], None]
Task = Callable[[Say], None]
Hear = Callable[[str, Any], None]
Engine = Callable[[Mapping[str, Task], Hear], dict[str, str]]
"""Runs tasks, calls with a task's name and what it said, and returns what went wrong with those that failed."""

# Several processes share the cores; none may use them all for itself.
ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
_SPAWN = multiprocessing.get_context("spawn")


def run_tasks(
    tasks: Mapping[str, Task],
    hear: Hear,
    jobs: int,
) -> dict[str, str]:
    """Run tasks, so many at a time, each in a new process.

    Args:
        tasks: name → what to do; it pickles, and is given a function by which to say things.
        hear: called with a task's name and what it said.
        jobs: how many at a time.

    Returns:
        Name → what went wrong, of the tasks that failed; the others go on.

    Raises:
        GymMaraError: jobs is no whole number of at least 1.
        KeyboardInterrupt: the user interrupted; no process is left.
    """
    jobs = whole_number("jobs", jobs)
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    waiting = list(tasks.items())
    running: dict[Connection, tuple[str, Any]] = {}
    failed: dict[str, str] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                name, task = waiting.pop(0)
                mouth, ear = _SPAWN.Pipe(duplex=False)[::-1]
                process = _SPAWN.Process(target=_work, args=(task, mouth), name=name)
                with _interrupts_later():
                    process.start()
                    running[ear] = name, process
                mouth.close()
            heard = wait(list(running))
            for ear in [ear for ear in running if ear in heard]:
                name, process = running[ear]
                try:
                    kind, message = ear.recv()
                except (EOFError, OSError):
                    process.join()
                    del running[ear]
                    if process.exitcode:
                        failed.setdefault(name, f"its process ended with {process.exitcode}")
                    continue
                if kind == "failed":
                    failed[name] = message
                else:
                    hear(name, message)
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join()
        for variable, value in before.items():
            if value is None:
                del os.environ[variable]
            else:
                os.environ[variable] = value
    return failed


@contextmanager
def _interrupts_later() -> Iterator[None]:
    """Hold interrupts back, here for a moment, in a process that begins meanwhile until it lets them in."""
    before = signal.getsignal(signal.SIGINT)
    heard: list[tuple[int, FrameType | None]] = []
    # The mask is inherited. Here it does not suffice: another thread may take the signal, and this one hears of it.
    here = callable(before) and threading.current_thread() is threading.main_thread()
    if here:
        signal.signal(signal.SIGINT, lambda number, frame: heard.append((number, frame)))
    try:
        with _masked():
            yield
    finally:
        if here:
            signal.signal(signal.SIGINT, before)
        if heard and callable(before):
            before(*heard[0])


@contextmanager
def _masked() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(task: Task, mouth: Connection) -> None:
    """In the process: do the task, and tell what went wrong."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears it too, and ends this process

    def say(message: Any) -> None:
        try:
            mouth.send(("said", message))
        except OSError:
            os._exit(1)  # nobody is left to hear

    reason = told(partial(task, say))
    if reason is not None:
        with suppress(OSError):
            mouth.send(("failed", reason))


def told(task: Callable[[], None]) -> str | None:
    """Do a task; what went wrong, in a line where the user can mend it, else with where it arose."""
    try:
        task()
    except Exception as error:
        known = isinstance(error, (GymMaraError, OSError))
        return str(error) if known else traceback.format_exc().rstrip()
    return None
