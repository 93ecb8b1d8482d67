"""Fixtures of the whole test suite."""

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
from tests.helpers import Cli, files_of_at_most, robot_model, write

# Tests run in several processes, and start more of them. All share the cores, so each uses one thread.
os.environ.update(dict.fromkeys(ONE_THREAD, "1"))

# After `make test &`, the tests and all processes that they start would ignore SIGINT.
if threading.current_thread() is threading.main_thread():
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Helper processes of multiprocessing, which live as long as the process that uses them.
_HELPERS = ("multiprocessing.resource_tracker", "multiprocessing.forkserver")
_LISTED = Path(f"/proc/self/task/{os.getpid()}/children").exists()
"""Whether the kernel lists the children of a process."""
_GRACE_PERIOD = 10.0
"""The time for a process to end after its test, s."""

settings.register_profile("gym_mara", deadline=None, max_examples=40, derandomize=True)
settings.load_profile("gym_mara")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that open Chromium as slow."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def small_files() -> Iterator[None]:
    """Files of this process may have at most 1,000 bytes."""
    with files_of_at_most(1000):
        yield


@pytest.fixture(autouse=True)
def _no_process_is_left_behind() -> Iterator[None]:
    """Fail a test that leaves child processes behind, and kill them."""
    before = _children()
    yield
    deadline = time.monotonic() + _GRACE_PERIOD
    while (remaining := _new_children(before)) and time.monotonic() < deadline:
        gc.collect()  # objects that a test did not close end their processes when they are collected
        time.sleep(0.05)
    commands = []
    for process in remaining:
        with contextlib.suppress(psutil.NoSuchProcess):
            commands.append(" ".join(process.cmdline()))
            for each in (process, *process.children(recursive=True)):
                each.kill()
    assert not commands, f"the test left these processes behind: {commands}"


def _children() -> set[psutil.Process]:
    """The child processes. psutil reads about all processes of the machine, and tests are many."""
    if not _LISTED:
        return set(psutil.Process().children())
    found = set()
    try:
        for path in Path("/proc/self/task").glob("*/children"):
            for pid in path.read_text().split():
                with contextlib.suppress(psutil.NoSuchProcess):
                    found.add(psutil.Process(int(pid)))
    except OSError:  # a thread has ended meanwhile
        return set(psutil.Process().children())
    return found


def _new_children(before: set[psutil.Process]) -> list[psutil.Process]:
    """The living child processes that are not in `before`, without the helpers of multiprocessing."""
    children = []
    for process in _children() - before:
        with contextlib.suppress(psutil.NoSuchProcess):
            command = " ".join(process.cmdline())  # empty for a zombie
            if command and not any(name in command for name in _HELPERS):
                children.append(process)
    return children


@pytest.fixture(scope="session")
def mara() -> RobotModel:
    """MARA, loaded once, because a RobotModel is immutable."""
    return robot_model("mara")


@pytest.fixture
def gym_mara(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Cli:
    """The command."""
    from gym_mara.cli import common  # only these tests need it

    monkeypatch.setenv("COLUMNS", "200")  # for the help
    for console in (common.out, common.err):
        monkeypatch.setattr(console, "width", 200)
    return Cli(monkeypatch, capsys)


@pytest.fixture
def fake_backend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Register FakeBackend and return its name."""
    return _register("fake", "tests.backends.fake:FakeBackend", tmp_path, monkeypatch)


@pytest.fixture
def tensor_backend(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Register TensorBackend and return its name."""
    return _register("tensors", "tests.backends.tensors:TensorBackend", tmp_path, monkeypatch)


def _register(name: str, value: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Register a backend by an entry point, as another package would; returns its name."""
    package = folder / f"gym_mara_{name}-0.1.dist-info"
    package.mkdir()
    write(package / "METADATA", f"Metadata-Version: 2.1\nName: gym_mara_{name}\nVersion: 0.1\n")
    write(package / "entry_points.txt", f"[gym_mara.backends]\n{name} = {value}\n")
    monkeypatch.syspath_prepend(folder)
    return name
