"""Runs jobs in processes of this machine, forwards their messages and reports crashes; an interrupt ends them all."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any, NamedTuple

from gym_mara.agents.experiments.executor import ONE_THREAD, Job, OnMessage, failure_of
from gym_mara.errors import whole_number

_SPAWN = multiprocessing.get_context("spawn")
_MESSAGE, _FAILURE = "message", "failure"


def run_in_processes(
    jobs: Mapping[str, Job], on_message: OnMessage, processes: int
) -> dict[str, str]:
    """Run jobs, each in a new process, a number of them at a time.

    Args:
        jobs: name → job.
        on_message: called with a job's name and each message that it sends.
        processes: how many run at a time.

    Returns:
        Name → reason, for each job that failed; a failure does not stop the others.

    Raises:
        GymMaraError: `processes` is not a whole number of at least 1.
        KeyboardInterrupt: the user interrupted; all processes have ended.
    """
    processes = whole_number("processes", processes)
    waiting = list(jobs.items())
    running: dict[Connection, _Running] = {}
    failures: dict[str, str] = {}
    try:
        while waiting or running:
            while waiting and len(running) < processes:
                _start(*waiting.pop(0), running)
            ready = wait(list(running))
            for reader in [reader for reader in running if reader in ready]:
                name, process = running[reader]
                try:
                    kind, content = reader.recv()
                except (EOFError, OSError):  # the process has ended
                    process.join()
                    del running[reader]
                    if process.exitcode:
                        failures.setdefault(name, _how_it_ended(process.exitcode))
                    continue
                if kind == _FAILURE:
                    failures[name] = content
                else:
                    on_message(name, content)
    finally:
        for _, process in running.values():
            process.terminate()
        for _, process in running.values():
            process.join()
    return failures


def _how_it_ended(code: int) -> str:
    """Why a process ended that sent no reason itself."""
    if code >= 0:
        return f"its process ended with {code}"
    try:
        name = signal.Signals(-code).name
    except ValueError:  # a real-time signal
        name = f"signal {-code}"
    return f"its process was ended by {name}"


class _Running(NamedTuple):
    """A job that runs."""

    name: str
    process: Any


def _start(name: str, job: Job, running: dict[Connection, _Running]) -> None:
    """Start a job's process, and enter it under the connection from which its messages are read."""
    reader, writer = _SPAWN.Pipe(duplex=False)
    process = _SPAWN.Process(target=_run, args=(job, writer), name=name)
    with _one_thread_each(), _interrupts_deferred():
        process.start()
        running[reader] = _Running(name, process)
    writer.close()


def _run(job: Job, writer: Connection) -> None:
    """In the new process: run the job, and send its messages and the reason if it failed."""
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # the parent gets the interrupt too, and ends this process

    def send(message: Any) -> None:
        try:
            writer.send((_MESSAGE, message))
        except OSError:
            os._exit(1)  # the parent has ended

    reason = failure_of(job, send)
    if reason is not None:
        with suppress(OSError):
            writer.send((_FAILURE, reason))


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Limit the libraries of processes that are started here to one thread each."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Deliver an interrupt after this block; in a process that is started here, after it has set its own handler."""
    before = signal.getsignal(signal.SIGINT)
    arrived: list[tuple[int, FrameType | None]] = []
    # A new process inherits the mask. In this process the mask is not enough: another thread may receive the signal,
    # and Python then calls the handler in this one.
    is_handled_here = callable(before) and threading.current_thread() is threading.main_thread()
    if is_handled_here:
        signal.signal(signal.SIGINT, lambda number, frame: arrived.append((number, frame)))
    try:
        with _interrupts_masked():
            yield
    finally:
        if is_handled_here:
            signal.signal(signal.SIGINT, before)
        if arrived and callable(before):
            before(*arrived[0])


@contextmanager
def _interrupts_masked() -> Iterator[None]:
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
