"""A process that runs the command gym-mara many times, for tests/test_cli_fuzz.py."""

from __future__ import annotations

import io
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import psutil

from gym_mara.errors import GymMaraError

LIMIT = 60.0
"""How long a call may take, s; alone on a machine the slowest takes about 15: a training of 512 arms on dart."""
_EPISODE_STEPS = 32
"""The episodes are short, so that a call takes little time where nothing is wrong with it."""
_START = 120.0
"""How long a worker may take for its imports, s."""
_SPAWN = multiprocessing.get_context("spawn")
_HELPERS = ("multiprocessing.resource_tracker", "multiprocessing.forkserver")


class Ended(NamedTuple):
    """How a call has ended."""

    code: object
    """Its exit code; None if it took too long or its process died."""
    output: str
    """Its stdout and its stderr."""
    children: list[str]
    """The processes that it left behind."""


class Worker:
    """Runs calls one after the other in a process of its own, which it replaces after a call that hangs."""

    def __init__(self) -> None:
        self._start()

    def _start(self) -> None:
        self._pipe, its_end = _SPAWN.Pipe()
        self._process = _SPAWN.Process(target=_work, args=(its_end,))
        self._process.start()
        its_end.close()
        assert self._pipe.poll(_START)
        self._pipe.recv()

    def call(self, arguments: list[str], folder: Path) -> Ended:
        """Run a command in a folder."""
        self._pipe.send((arguments, folder))
        with suppress(EOFError):
            if self._pipe.poll(LIMIT):
                return Ended(*self._pipe.recv())
        trace = self.close()
        self._start()
        return Ended(None, trace, [])

    def close(self) -> str:
        """Kill the process and all that it started; returns why it may have died."""
        died = self._process.exitcode
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid or 0, signal.SIGKILL)
        self._process.join()
        self._pipe.close()
        return f"no end after {LIMIT:g} s" if died is None else f"its process ended with {died}"


def _work(pipe: Connection) -> None:
    os.setsid()
    _prepare()
    pipe.send(None)
    with suppress(EOFError):
        while True:
            pipe.send(_run(*pipe.recv()))


def _prepare() -> None:
    """Import what the commands import, and replace what would start processes or wait for a user."""
    # What the first calls would import, for seconds.
    import mujoco_warp  # noqa: F401
    import plotly.graph_objects  # noqa: F401
    import pyvista  # noqa: F401
    import torch._dynamo  # noqa: F401

    from gym_mara import (
        cli,  # noqa: F401
        registration,
    )
    from gym_mara.agents.experiments import figures, local_executor, search  # noqa: F401
    from gym_mara.agents.experiments.executor import Job, OnMessage, failure_of
    from gym_mara.agents.export import run  # noqa: F401
    from gym_mara.agents.inspection import report
    from gym_mara.agents.training.train import use_one_thread
    from gym_mara.datasets.hand import HandViewer
    from gym_mara.viewer.viewer import Viewer

    def run_here(jobs: Mapping[str, Job], on_message: OnMessage, processes: int) -> dict[str, str]:
        ended = {name: failure_of(job, partial(on_message, name)) for name, job in jobs.items()}
        return {name: reason for name, reason in ended.items() if reason is not None}

    def interrupted(*arguments: Any) -> None:
        raise KeyboardInterrupt

    for name, environment in registration.ENVIRONMENTS.items():
        registration.ENVIRONMENTS[name] = environment._replace(max_episode_steps=_EPISODE_STEPS)
    vars(local_executor)["run_in_processes"] = vars(search)["run_in_processes"] = run_here
    vars(report)["_VIDEO_SECONDS"] = 0.1
    setattr(Viewer, "run", interrupted)  # noqa: B010
    setattr(HandViewer, "episode", interrupted)  # noqa: B010
    use_one_thread()
    _wait_for_no_arm()


def _wait_for_no_arm() -> None:
    """Let the commands of ROS 2 wait for no arm, in a domain of this process on this machine, where there is none."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    with suppress(GymMaraError):
        from gym_mara.backends import ros2
        from gym_mara.ros2 import check, link
        from gym_mara.ros2.bags import recording
        from gym_mara.ros2.sim import node

        for module, name in (
            (ros2, "_CONNECTING"),
            (check, "DISCOVERY"),
            (check, "_WAITING"),
            (link, "DISCOVERY"),
            (node, "DISCOVERY"),
            (recording, "DISCOVERY"),
            (recording, "PATIENCE"),
        ):
            assert name in vars(module)
            vars(module)[name] = 0.02


def _run(arguments: list[str], folder: Path) -> tuple[object, str, list[str]]:
    from gym_mara.cli import main

    os.chdir(folder)
    written = io.BytesIO()
    sys.stdout = sys.stderr = io.TextIOWrapper(written, "utf-8", write_through=True)
    sys.argv = ["gym-mara", *arguments]
    code: object = "no SystemExit"
    try:
        main()
    except SystemExit as exit_:
        code = exit_.code
    except BaseException as error:
        code = repr(error)
    output = written.getvalue().decode()
    return code, output, _children()


def _children() -> list[str]:
    """The commands of the processes that are left after a moment; they are killed."""
    deadline = time.monotonic() + 5.0
    while (left := _living()) and time.monotonic() < deadline:
        time.sleep(0.02)
    for child in left.values():
        child.kill()
    return list(left)


def _living() -> dict[str, psutil.Process]:
    found = {}
    for child in psutil.Process().children(recursive=True):
        with suppress(psutil.NoSuchProcess):
            command = " ".join(child.cmdline())
            if command and not any(helper in command for helper in _HELPERS):
                found[command] = child
    return found
