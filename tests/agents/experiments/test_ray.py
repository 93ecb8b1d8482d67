"""A grid on Ray: it gives the same results as local processes, even if a worker is killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import ray

from gym_mara.agents.experiments.executor import Send
from gym_mara.agents.experiments.grid import read_result, run_grid, run_one
from gym_mara.agents.experiments.ray_executor import run_on_ray
from gym_mara.backends.workers import choose_workers
from gym_mara.cli.experiments import _executor
from gym_mara.errors import GymMaraError
from tests.agents.experiments.conftest import GRID

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cluster() -> Iterator[None]:
    """A local Ray cluster with two workers."""
    ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
    yield
    ray.shutdown()


@pytest.mark.usefixtures("cluster")
def test_a_grid_gives_the_same_results_if_a_worker_is_killed(
    finished_grid: Path, tmp_path: Path
) -> None:
    killed: list[int] = []

    def kill_a_worker(name: str, message: Any) -> None:
        worker = _worker("MARAGoal-v0_ppo_0")
        checkpoints = list((tmp_path / "ray").glob("MARAGoal-v0_ppo_0/checkpoints/*"))
        if not killed and checkpoints and worker is not None:
            os.kill(worker, signal.SIGKILL)
            killed.append(worker)

    assert run_grid(tmp_path / "ray", GRID, run_on_ray, kill_a_worker) == {}
    assert killed, "the grid ended before a worker could be killed"
    for name in GRID.runs():
        mine, theirs = read_result(tmp_path / "ray" / name), read_result(finished_grid / name)
        assert mine is not None
        assert theirs is not None
        assert mine["last"] == theirs["last"]
        assert mine["best"] == theirs["best"]


def _worker(job: str) -> int | None:
    """The process in which Ray runs the job of this name, a descendant of this process."""
    for process in psutil.Process().children(recursive=True):
        if process.status() != psutil.STATUS_ZOMBIE and f"ray::{job}" in " ".join(
            process.cmdline()
        ):
            return process.pid
    return None


@pytest.mark.usefixtures("cluster")
def test_a_failed_job_is_reported_and_the_others_go_on() -> None:
    messages: list[tuple[str, Any]] = []
    jobs = {"good": _send_workers, "bad": _fail, "broken": _break}
    failed = run_on_ray(jobs, lambda name, message: messages.append((name, message)))
    assert messages == [("good", 1)]  # a job has one core, so its backend starts no workers
    assert failed["bad"] == "no such thing"
    assert "ZeroDivisionError" in failed["broken"]
    assert "_break" in failed["broken"], "the traceback"


def _send_workers(send: Send) -> None:
    send(choose_workers(64, None))


def _fail(send: Send) -> None:
    raise GymMaraError("no such thing")


def _break(send: Send) -> None:
    send(1 / 0)


def test_a_missing_cluster_is_an_error(tmp_path: Path) -> None:
    options = ["--steps", "1000", "--executor", "ray", "--address", "127.0.0.1:1"]
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
    ("executor", "jobs", "address", "reason"),
    [
        ("cloud", None, None, "unknown executor 'cloud'.*local, ray"),
        ("ray", 2, None, "--jobs is for --executor local only"),
        ("local", None, "somewhere:6379", "--address is for --executor ray only"),
    ],
)
def test_contradictory_options_are_refused(
    executor: str, jobs: int | None, address: str | None, reason: str
) -> None:
    with pytest.raises(GymMaraError, match=reason):
        _executor(executor, jobs, address)


def test_a_machine_that_does_not_see_the_grid_reports_it(tmp_path: Path) -> None:
    name, config = next(iter(GRID.runs().items()))
    with pytest.raises(
        GymMaraError, match=r"does not see the grid.*storage that all machines share"
    ):
        run_one(tmp_path / "elsewhere" / name, config, print)
