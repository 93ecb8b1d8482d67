"""Fixtures of the whole suite."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from hypothesis import settings

from gym_mara.agents.experiments.executor import ONE_THREAD
from gym_mara.robot import RobotModel
from tests.helpers import robot_model, write

# Tests run in several processes, which share the cores, and so do the processes that they begin.
os.environ.update(dict.fromkeys(ONE_THREAD, "1"))

# A shell that runs `make test &` ignores SIGINT, and so would every process that the tests start.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Helpers of multiprocessing that live as long as the process that uses them.
_LASTING = ("multiprocessing.resource_tracker", "multiprocessing.forkserver")
_GRACE = 10.0
"""How long a process may take to end after its test, s."""

settings.register_profile("gym_mara", deadline=None, max_examples=40, derandomize=True)
settings.load_profile("gym_mara")


@pytest.fixture(autouse=True)
def _no_process_is_left_behind() -> Iterator[None]:
    """Kill the processes that a test has started and not ended, and fail the test."""
    before = set(psutil.Process().children())
    yield
    deadline = time.monotonic() + _GRACE
    while (left := _new_children(before)) and time.monotonic() < deadline:
        gc.collect()  # what a test has dropped without closing it ends its processes
        time.sleep(0.05)
    commands = []
    for process in left:
        with contextlib.suppress(psutil.NoSuchProcess):
            commands.append(" ".join(process.cmdline()))
            for each in (process, *process.children(recursive=True)):
                each.kill()
    assert not commands, f"the test left processes behind: {commands}"


def _new_children(before: set[psutil.Process]) -> list[psutil.Process]:
    """The living child processes that were not there before, without those that multiprocessing keeps."""
    children = []
    for process in set(psutil.Process().children()) - before:
        with contextlib.suppress(psutil.NoSuchProcess):
            command = " ".join(process.cmdline())  # empty once it is a zombie
            if command and not any(name in command for name in _LASTING):
                children.append(process)
    return children


@pytest.fixture(scope="session")
def mara() -> RobotModel:
    """MARA, loaded once: a RobotModel does not change."""
    return robot_model("mara")


@pytest.fixture
def fake_backend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The name of FakeBackend, offered as another package would: by an entry point."""
    package = tmp_path / "gym_mara_fake-0.1.dist-info"
    package.mkdir()
    write(package / "METADATA", "Metadata-Version: 2.1\nName: gym_mara_fake\nVersion: 0.1\n")
    write(
        package / "entry_points.txt",
        "[gym_mara.backends]\nfake = tests.backends.fake:FakeBackend\n",
    )
    monkeypatch.syspath_prepend(tmp_path)
    return "fake"
