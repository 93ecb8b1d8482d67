"""A grid on Ray: the results are those of processes of one machine, also where a worker is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
import ray

from gym_mara.agents.experiments.grid import Grid, read_result, run_grid, run_one
from gym_mara.agents.experiments.local import Say, run_tasks
from gym_mara.agents.experiments.ray import run_on_ray
from gym_mara.backends.workers import choose_workers
from gym_mara.cli.experiments import _engine
from gym_mara.errors import GymMaraError

GRID = Grid(envs=("MARA-v0",), algos=("ppo", "acktr"), seeds=1, steps=8192, checkpoint_every=2048)


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A local Ray of two workers."""
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


def deaf(name: str, message: Any) -> None:
    """What the tasks say is not heard."""


@pytest.mark.usefixtures("cluster")
def test_a_grid_ends_alike_though_a_worker_is_killed(tmp_path: Path) -> None:
    killed: list[int] = []

    def hear(name: str, message: Any) -> None:
        worker = _worker("MARA-v0_ppo_0")
        checkpoints = list((tmp_path / "ray").glob("MARA-v0_ppo_0/checkpoints/*"))
        if not killed and checkpoints and worker is not None:
            os.kill(worker, signal.SIGKILL)
            killed.append(worker)

    assert run_grid(tmp_path / "ray", GRID, run_on_ray, hear) == {}
    assert killed, "the grid ended before a worker could be killed"
    assert run_grid(tmp_path / "local", GRID, partial(run_tasks, jobs=2), deaf) == {}
    for name in GRID.runs():
        mine, its = read_result(tmp_path / "ray" / name), read_result(tmp_path / "local" / name)
        assert mine is not None
        assert its is not None
        assert mine["last"] == its["last"]
        assert mine["best"] == its["best"]


def _worker(task: str) -> int | None:
    """The process in which Ray runs a task of this name, a descendant of this one."""
    for process in psutil.Process().children(recursive=True):
        if process.status() != psutil.STATUS_ZOMBIE and f"ray::{task}" in " ".join(
            process.cmdline()
        ):
            return process.pid
    return None


@pytest.mark.usefixtures("cluster")
def test_one_that_fails_is_told_and_the_others_go_on() -> None:
    heard: list[tuple[str, Any]] = []
    tasks = {"good": _says, "bad": _fails, "broken": _breaks}
    failed = run_on_ray(tasks, lambda name, message: heard.append((name, message)))
    assert heard == [("good", 1)]  # one of the cores, and no worker processes of its own
    assert failed["bad"] == "no such thing"
    assert "ZeroDivisionError" in failed["broken"]
    assert "_breaks" in failed["broken"], "where it arose"


def _says(say: Say) -> None:
    say(choose_workers(64, None))


def _fails(say: Say) -> None:
    raise GymMaraError("no such thing")


def _breaks(say: Say) -> None:
    say(1 / 0)


def test_a_cluster_that_is_not_there_is_told(tmp_path: Path) -> None:
    options = ["--steps", "1000", "--engine", "ray", "--address", "127.0.0.1:1"]
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "gym_mara.cli",
            "benchmark",
            *options,
            "--out",
            str(tmp_path / "grid"),
        ],
        check=False,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 2
    assert "there is no Ray cluster at '127.0.0.1:1'" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("engine", "jobs", "address", "reason"),
    [
        ("cloud", None, None, "unknown engine 'cloud'.*local, ray"),
        ("ray", 2, None, "--jobs counts processes of this machine"),
        ("local", None, "somewhere:6379", "give --engine ray too"),
    ],
)
def test_options_that_contradict_each_other_are_told(
    engine: str, jobs: int | None, address: str | None, reason: str
) -> None:
    with pytest.raises(GymMaraError, match=reason):
        _engine(engine, jobs, address)


def test_a_machine_that_does_not_find_the_grid_says_so(tmp_path: Path) -> None:
    name, config = next(iter(GRID.runs().items()))
    with pytest.raises(
        GymMaraError, match=r"does not find the grid.*storage that all machines share"
    ):
        run_one(tmp_path / "elsewhere" / name, config, print)
