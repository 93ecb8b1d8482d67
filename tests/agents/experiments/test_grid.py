"""The grid of runs: it finishes what was begun, keeps what has finished, and sets aside what is damaged."""

from __future__ import annotations

import csv
import json
import os
import resource
import shutil
import signal
import threading
import time
from dataclasses import replace
from functools import partial
from multiprocessing.context import SpawnProcess
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from filelock import FileLock

from gym_mara.agents.algorithms.registry import ALGORITHMS, algorithm
from gym_mara.agents.experiments import grid as benchmark
from gym_mara.agents.experiments.figures import format_interval, interquartile_mean, plot_grid
from gym_mara.agents.experiments.grid import Grid, open_grid, read_result, run_grid
from gym_mara.agents.experiments.local import Engine, Say, run_tasks
from gym_mara.backends.workers import choose_workers
from gym_mara.errors import GymMaraError
from tests.helpers import started

GRID = Grid(envs=("MARA-v0",), algos=("ppo", "acktr"), seeds=1, steps=4096, checkpoint_every=2048)


def deaf(name: str, message: Any) -> None:
    """What the runs say is not heard."""


def processes(jobs: int) -> Engine:
    """So many processes of this machine."""
    return partial(run_tasks, jobs=jobs)


@pytest.fixture(scope="session")
def finished_grid(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A grid that was trained to its end; tests must not change it."""
    folder = Path(tmp_path_factory.mktemp("grids")) / "grid"
    assert run_grid(folder, GRID, processes(2), deaf) == {}
    return folder


def test_every_run_leaves_its_result(finished_grid: Path) -> None:
    assert set(GRID.runs()) == {f"MARA-v0_{algo}_0" for algo in GRID.algos}
    for name in GRID.runs():
        result = read_result(finished_grid / name)
        assert result is not None
        assert result["last"]["position_error_mm"] > 0.0
        assert result["seconds"] > 0.0


def test_what_has_finished_is_not_trained_again(finished_grid: Path) -> None:
    said: list[str] = []
    assert (
        run_grid(finished_grid, GRID, processes(1), lambda name, message: said.append(name)) == {}
    )
    assert not any(said)


def test_a_grid_that_is_killed_goes_on_and_ends_alike(finished_grid: Path, tmp_path: Path) -> None:
    folder = tmp_path / "grid"
    options = ["--envs", "MARA-v0", "--algos", "ppo,acktr", "--seeds", "1", "--steps", "4096"]
    command = ["-m", "gym_mara.cli", "benchmark", *options, "--jobs", "2"]
    command += ["--checkpoint-every", "2048", "--out", str(folder)]
    with started(*command) as process:
        deadline = time.monotonic() + 120
        while not list(folder.glob("*/checkpoints/2*")):
            assert process.poll() is None, "the grid ended early"
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert run_grid(folder, GRID, processes(2), deaf) == {}
    for name in GRID.runs():
        mine, theirs = read_result(folder / name), read_result(finished_grid / name)
        assert mine is not None
        assert theirs is not None
        assert mine["last"] == theirs["last"]


@pytest.mark.parametrize("victim", ["config.json", "last/model.zip", "progress.csv"])
def test_a_damaged_run_is_named_set_aside_and_run_again(
    finished_grid: Path, tmp_path: Path, victim: str
) -> None:
    folder, name = tmp_path / "grid", "MARA-v0_acktr_0"
    shutil.copytree(finished_grid, folder)
    before = read_result(folder / name)
    (folder / name / "result.json").unlink()
    (folder / name / victim).write_bytes(b"\x00 no such thing")
    said: list[Any] = []
    assert (
        run_grid(folder, GRID, processes(1), lambda who, message: said.append((who, message))) == {}
    )
    assert any(who == name and "set aside" in str(message) for who, message in said)
    assert (folder / f"{name}.damaged1").is_dir()
    after = read_result(folder / name)
    assert before is not None
    assert after is not None
    assert after["last"] == before["last"]


def test_without_room_to_write_runs_fail_and_can_be_gone_on_with(
    finished_grid: Path, tmp_path: Path
) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))  # of any file, as on a full disk
        failed = run_grid(tmp_path / "grid", GRID, processes(2), deaf)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert failed.keys() == GRID.runs().keys()
    assert all("File too large" in reason for reason in failed.values())
    assert run_grid(tmp_path / "grid", GRID, processes(2), deaf) == {}
    for name in GRID.runs():
        mine, theirs = read_result(tmp_path / "grid" / name), read_result(finished_grid / name)
        assert mine is not None
        assert theirs is not None
        assert mine["last"] == theirs["last"]


def test_a_run_that_another_process_trains_is_left_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(benchmark, "PATIENCE", 0.1)
    name, config = next(iter(GRID.runs().items()))
    with (
        FileLock(tmp_path / f".{name}.lock"),
        pytest.raises(GymMaraError, match="another process is training"),
    ):
        benchmark.run_one(tmp_path / name, config, print)
    assert not (tmp_path / name).exists()


def test_a_run_that_is_trained_by_itself_is_left_alone(finished_grid: Path, tmp_path: Path) -> None:
    name, config = next(iter(GRID.runs().items()))
    path = shutil.copytree(finished_grid / name, tmp_path / name)
    shutil.rmtree(path / "last")
    (path / "result.json").unlink()
    with (
        FileLock(path / ".lock"),
        pytest.raises(GymMaraError, match="another process is training"),
    ):
        benchmark.run_one(path, config, print)
    assert not list(tmp_path.glob("*damaged*"))
    benchmark.run_one(path, config, print)
    assert read_result(path) is not None


def test_the_folder_of_another_grid_is_refused(
    finished_grid: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(GymMaraError, match=r"another grid .*steps 4096 there, 8192 now"):
        open_grid(finished_grid, replace(GRID, steps=8192))
    ppo = algorithm("ppo")
    changed = replace(ppo, presets={"tuned": ppo.presets["paper"]})
    monkeypatch.setitem(ALGORITHMS, "ppo", changed)
    with pytest.raises(GymMaraError, match="made with other 'tuned' presets"):
        open_grid(finished_grid, GRID)
    (tmp_path / "something").touch()
    with pytest.raises(GymMaraError, match="neither empty nor a grid"):
        open_grid(tmp_path, GRID)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"envs": ("MARA-v1",)}, "environment"),
        ({"algos": ("ppo2",)}, "algorithm"),
        ({"preset_name": "papers"}, "preset"),
        ({"envs": ("MARA-v0", "MARA-v0")}, "name each once"),
        ({"algos": ("ppo", "ppo")}, "name each once"),
        ({"seeds": 0}, "seeds"),
        ({"steps": -1}, "steps"),
    ],
)
def test_a_grid_of_nonsense_is_refused(
    tmp_path: Path, change: dict[str, Any], complaint: str
) -> None:
    with pytest.raises(GymMaraError, match=complaint):
        open_grid(tmp_path / "grid", replace(GRID, **change))
    assert not (tmp_path / "grid").exists()


def test_figures_and_tables_show_every_run(finished_grid: Path, tmp_path: Path) -> None:
    finished_grid = shutil.copytree(finished_grid, tmp_path / "grid")
    files = plot_grid(finished_grid)
    assert {file.name for file in files} == {
        "MARA-v0.png",
        "MARA-v0_acktr.png",
        "MARA-v0_ppo.png",
        "curves.csv",
        "table.csv",
        "table.md",
    }
    with (finished_grid / "curves.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {(row["algo"], row["seed"]) for row in rows} == {("ppo", "0"), ("acktr", "0")}
    text = (finished_grid / "table.md").read_text()
    assert "| MARA-v0 | PPO | 1 |" in text
    assert "| MARA-v0 | ACKTR | 1 |" in text


def test_a_finished_run_that_is_damaged_later_is_named(finished_grid: Path, tmp_path: Path) -> None:
    folder = tmp_path / "grid"
    shutil.copytree(finished_grid, folder)
    (folder / "MARA-v0_ppo_0" / "progress.csv").write_text("time/total_timesteps\nmany\n")
    with pytest.raises(GymMaraError, match=r"MARA-v0_ppo_0' is damaged.*train it again"):
        plot_grid(folder)


def test_what_has_not_finished_is_left_out_of_the_figures(
    finished_grid: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "grid"
    shutil.copytree(finished_grid, folder)
    (folder / "MARA-v0_acktr_0" / "result.json").unlink()
    files = {file.name for file in plot_grid(folder)}
    assert files == {"MARA-v0.png", "MARA-v0_ppo.png", "curves.csv", "table.csv", "table.md"}


def test_a_folder_without_results_has_no_figures(tmp_path: Path) -> None:
    with pytest.raises(GymMaraError, match=r"no grid\.json"):
        plot_grid(tmp_path)
    open_grid(tmp_path / "grid", GRID)
    with pytest.raises(GymMaraError, match="no run of the grid"):
        plot_grid(tmp_path / "grid")


def test_the_interquartile_mean_leaves_out_the_outer_quarters() -> None:
    interval = interquartile_mean([1.0, 2.0, 3.0, 1000.0])
    assert interval.mean == 2.5
    assert interval.low <= 2.5 <= interval.high
    assert interquartile_mean([1.0, 2.0, 6.0]).mean == 3.0
    assert format_interval(interquartile_mean([1.0, 1.0]), 1) == "1.0"
    assert format_interval(interquartile_mean([1.0, np.inf, np.inf]), 1) == "-"


def _dies(say: Say) -> None:
    say("alive")
    os.kill(os.getpid(), signal.SIGKILL)


def _speaks(say: Say) -> None:
    say("hello")


def _errs(say: Say) -> None:
    raise OSError(28, "No space left on device")


def _blunders(say: Say) -> None:
    raise ZeroDivisionError("in the task")


def _counts_workers(say: Say) -> None:
    say(choose_workers(12, None))


def test_a_task_has_its_core_and_no_more() -> None:
    heard: list[Any] = []
    run_tasks({"one": _counts_workers}, lambda name, message: heard.append(message), 1)
    assert heard == [1]


def test_a_task_whose_process_dies_does_not_stop_the_others() -> None:
    heard: list[tuple[str, Any]] = []
    tasks = {"dying": _dies, "full": _errs, "blundering": _blunders, "well": _speaks}
    failed = run_tasks(tasks, lambda name, message: heard.append((name, message)), 1)
    assert failed.keys() == {"dying", "full", "blundering"}
    assert "_blunders" in failed["blundering"], "where it arose"
    assert "ended with -9" in failed["dying"]
    assert "No space left" in failed["full"]
    assert ("well", "hello") in heard


def _sleeps(file: Path, say: Say) -> None:
    file.write_text(str(os.getpid()))
    say("up")
    time.sleep(600)


def test_an_interrupt_leaves_no_process_behind(tmp_path: Path) -> None:
    def interrupt(name: str, message: Any) -> None:
        if message == "up":
            raise KeyboardInterrupt

    file = tmp_path / "pid"
    before = dict(os.environ)
    with pytest.raises(KeyboardInterrupt):
        run_tasks({"sleeping": partial(_sleeps, file)}, interrupt, 1)
    assert dict(os.environ) == before
    with pytest.raises(ProcessLookupError):
        os.kill(int(file.read_text()), 0)


def test_an_interrupt_leaves_no_process_that_has_just_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun: list[BaseProcess] = []
    start, end = SpawnProcess.start, threading.Event()

    def interrupted(process: BaseProcess) -> None:
        start(process)
        begun.append(process)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)

    monkeypatch.setattr(SpawnProcess, "start", interrupted)
    other = threading.Thread(target=end.wait)  # it takes the signal where the main thread does not
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_tasks({"sleeping": partial(_sleeps, tmp_path / "pid")}, deaf, 1)
    finally:
        end.set()
        other.join()
    assert [process.exitcode for process in begun] == [-signal.SIGTERM]


def test_jobs_must_be_a_number_of_processes() -> None:
    with pytest.raises(GymMaraError, match="jobs"):
        run_tasks({}, deaf, 0)


def test_the_grid_says_what_it_is(finished_grid: Path) -> None:
    about = json.loads((finished_grid / "grid.json").read_text())
    assert about["algos"] == ["ppo", "acktr"]
    assert about["preset_name"] == "tuned"
