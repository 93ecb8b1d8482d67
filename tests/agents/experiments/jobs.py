"""Jobs of the tests of executors, in a module that a new process imports quickly."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

from gym_mara.agents.experiments.executor import Send
from gym_mara.backends.workers import choose_workers


def die(send: Send) -> None:
    send("alive")
    os.kill(os.getpid(), signal.SIGKILL)


def greet(send: Send) -> None:
    send("hello")


def fill_the_disk(send: Send) -> None:
    raise OSError(28, "No space left on device")


def divide_by_zero(send: Send) -> None:
    raise ZeroDivisionError("in the job")


def send_workers(send: Send) -> None:
    send(choose_workers(12, None))


def sleep(file: Path, send: Send) -> None:
    file.write_text(str(os.getpid()))
    send("started")
    time.sleep(600)
