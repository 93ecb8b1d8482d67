"""The grid of runs: it resumes interrupted runs, keeps finished ones, and trains damaged ones again."""

from __future__ import annotations

import csv
import json
import os
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
from gym_mara.agents.experiments import grid as grid_module
from gym_mara.agents.experiments.figures import format_interval, interquartile_mean, plot_grid
from gym_mara.agents.experiments.grid import open_grid, read_result, run_grid
from gym_mara.agents.experiments.local_executor import run_in_processes
from gym_mara.errors import GymMaraError
from tests.agents.experiments import jobs
from tests.agents.experiments.conftest import GRID, ignore, in_this_process
from tests.helpers import files_of_at_most, started

pytestmark = pytest.mark.slow

two_processes = partial(run_in_processes, processes=2)


def test_every_run_writes_its_result(finished_grid: Path) -> None:
    assert set(GRID.runs()) == {f"MARAGoal-v0_{algo}_0" for algo in GRID.algos}
    for name in GRID.runs():
        result = read_result(finished_grid / name)
        assert result is not None
        assert (result["last"]["position_error_mm"] or 0.0) > 0.0
        assert result["seconds"] > 0.0


def test_finished_runs_are_not_trained_again(finished_grid: Path) -> None:
    senders: list[str] = []
    assert (
        run_grid(finished_grid, GRID, in_this_process, lambda name, message: senders.append(name))
        == {}
    )
    assert not senders


def test_a_killed_grid_is_resumed_with_the_same_results(
    finished_grid: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "grid"
    options = ["--env", "MARAGoal-v0", "--algo", "ppo,acktr", "--seeds", "1", "--steps", "4096"]
    command = ["-m", "gym_mara.cli", "benchmark", *options, "--jobs", "2"]
    command += ["--checkpoint-every", "2048", "--out", str(folder)]
    with started(*command) as process:
        deadline = time.monotonic() + 120
        while not list(folder.glob("*/checkpoints/2*")):
            assert process.poll() is None, "the grid ended early"
            assert time.monotonic() < deadline
            time.sleep(0.01)
    assert run_grid(folder, GRID, in_this_process, ignore) == {}
    for name in GRID.runs():
        mine, theirs = read_result(folder / name), read_result(finished_grid / name)
        assert mine is not None
        assert theirs is not None
        assert mine["last"] == theirs["last"]


@pytest.mark.parametrize("victim", ["config.json", "last/model.zip", "progress.csv"])
def test_a_damaged_run_is_renamed_and_trained_again(
    finished_grid: Path, tmp_path: Path, victim: str
) -> None:
    folder, name = tmp_path / "grid", "MARAGoal-v0_acktr_0"
    shutil.copytree(finished_grid, folder)
    before = read_result(folder / name)
    (folder / name / "result.json").unlink()
    (folder / name / victim).write_bytes(b"\x00 no such thing")
    messages: list[Any] = []
    assert run_grid(folder, GRID, in_this_process, lambda *sent: messages.append(sent)) == {}
    assert any(who == name and "renamed" in str(message) for who, message in messages)
    assert (folder / f"{name}.damaged1").is_dir()
    after = read_result(folder / name)
    assert before is not None
    assert after is not None
    assert after["last"] == before["last"]


def test_a_damaged_result_is_renamed_and_written_again(finished_grid: Path, tmp_path: Path) -> None:
    folder, name = shutil.copytree(finished_grid, tmp_path / "grid"), "MARAGoal-v0_ppo_0"
    before = read_result(folder / name)
    assert before is not None
    (folder / name / "result.json").write_text("{}")
    messages: list[Any] = []
    assert run_grid(folder, GRID, in_this_process, lambda *sent: messages.append(sent)) == {}
    assert messages[0] == (
        name,
        "result.json is damaged, or of an older version; renamed to 'result.json.damaged1' and written again",
    )
    error = before["last"]["position_error_mm"]
    assert messages[1] == (name, (GRID.steps, {"eval_position_error_mm": error}))
    assert read_result(folder / name) == before


def test_runs_that_failed_on_a_full_disk_are_resumed(finished_grid: Path, tmp_path: Path) -> None:
    with files_of_at_most(20_000):  # as on a full disk
        failed = run_grid(tmp_path / "grid", GRID, two_processes, ignore)
    assert failed.keys() == GRID.runs().keys()
    assert all("File too large" in reason for reason in failed.values())
    assert run_grid(tmp_path / "grid", GRID, in_this_process, ignore) == {}
    for name in GRID.runs():
        mine, theirs = read_result(tmp_path / "grid" / name), read_result(finished_grid / name)
        assert mine is not None
        assert theirs is not None
        assert mine["last"] == theirs["last"]


def test_a_run_that_another_process_holds_is_not_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(grid_module, "PATIENCE", 0.1)
    name, config = next(iter(GRID.runs().items()))
    with (
        FileLock(tmp_path / f".{name}.lock"),
        pytest.raises(GymMaraError, match="another process is training"),
    ):
        grid_module.run_one(tmp_path / name, config, print)
    assert not (tmp_path / name).exists()


def test_a_run_that_gym_mara_train_holds_is_not_trained(
    finished_grid: Path, tmp_path: Path
) -> None:
    name, config = next(iter(GRID.runs().items()))
    path = shutil.copytree(finished_grid / name, tmp_path / name)
    shutil.rmtree(path / "last")
    (path / "result.json").unlink()
    with (
        FileLock(path / ".lock"),
        pytest.raises(GymMaraError, match="another process is training"),
    ):
        grid_module.run_one(path, config, print)
    assert not list(tmp_path.glob("*damaged*"))
    grid_module.run_one(path, config, print)
    assert read_result(path) is not None


def test_a_folder_with_another_grid_is_refused(
    finished_grid: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(GymMaraError, match=r"another grid .*steps 4096 there, 8192 now"):
        open_grid(finished_grid, replace(GRID, steps=8192))
    ppo = algorithm("ppo")
    changed = replace(ppo, presets={"tuned": ppo.presets["paper"]})
    monkeypatch.setitem(ALGORITHMS, "ppo", changed)
    with pytest.raises(GymMaraError, match="the 'tuned' presets have changed"):
        open_grid(finished_grid, GRID)
    (tmp_path / "something").touch()
    with pytest.raises(GymMaraError, match="holds files but no grid"):
        open_grid(tmp_path, GRID)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"envs": ("MARA-v1",)}, "environment"),
        ({"algos": ("ppo2",)}, "algorithm"),
        ({"preset_name": "papers"}, "preset"),
        ({"envs": ("MARAGoal-v0", "MARAGoal-v0")}, "give each name once"),
        ({"algos": ("ppo", "ppo")}, "give each name once"),
        ({"seeds": 0}, "seeds"),
        ({"steps": -1}, "steps"),
    ],
)
def test_a_wrong_grid_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        open_grid(tmp_path / "grid", replace(GRID, **change))
    assert not (tmp_path / "grid").exists()


def test_figures_and_tables_contain_every_run(finished_grid: Path, tmp_path: Path) -> None:
    finished_grid = shutil.copytree(finished_grid, tmp_path / "grid")
    files = plot_grid(finished_grid)
    assert {file.name for file in files} == {
        "MARAGoal-v0.png",
        "MARAGoal-v0_acktr.png",
        "MARAGoal-v0_ppo.png",
        "curves.csv",
        "table.csv",
        "table.md",
    }
    with (finished_grid / "curves.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert {(row["algo"], row["seed"]) for row in rows} == {("ppo", "0"), ("acktr", "0")}
    text = (finished_grid / "table.md").read_text()
    assert "| MARAGoal-v0 | PPO | 1 |" in text
    assert "| MARAGoal-v0 | ACKTR | 1 |" in text


def test_a_finished_run_that_was_damaged_later_is_reported(
    finished_grid: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "grid"
    shutil.copytree(finished_grid, folder)
    (folder / "MARAGoal-v0_ppo_0" / "progress.csv").write_text("time/total_timesteps\nmany\n")
    with pytest.raises(GymMaraError, match=r"MARAGoal-v0_ppo_0' is damaged.*train it again"):
        plot_grid(folder)


def test_unfinished_runs_are_left_out_of_the_figures(finished_grid: Path, tmp_path: Path) -> None:
    folder = tmp_path / "grid"
    shutil.copytree(finished_grid, folder)
    (folder / "MARAGoal-v0_acktr_0" / "result.json").unlink()
    files = {file.name for file in plot_grid(folder)}
    assert files == {
        "MARAGoal-v0.png",
        "MARAGoal-v0_ppo.png",
        "curves.csv",
        "table.csv",
        "table.md",
    }


def test_a_folder_without_results_has_no_figures(tmp_path: Path) -> None:
    with pytest.raises(GymMaraError, match=r"there is no grid\.json"):
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


def test_the_backend_of_a_job_starts_no_workers() -> None:
    messages: list[Any] = []
    run_in_processes({"one": jobs.send_workers}, lambda name, message: messages.append(message), 1)
    assert messages == [1]


def test_a_job_that_fails_does_not_stop_the_others() -> None:
    messages: list[tuple[str, Any]] = []
    all_of_them = {
        "dead": jobs.die,
        "full": jobs.fill_the_disk,
        "broken": jobs.divide_by_zero,
        "good": jobs.greet,
    }
    failed = run_in_processes(all_of_them, lambda *sent: messages.append(sent), 1)
    assert failed.keys() == {"dead", "full", "broken"}
    assert "divide_by_zero" in failed["broken"], "the traceback"
    assert "ended by SIGKILL" in failed["dead"]
    assert "No space left" in failed["full"]
    assert ("good", "hello") in messages


def test_an_interrupt_leaves_no_process_behind(tmp_path: Path) -> None:
    def interrupt(name: str, message: Any) -> None:
        if message == "started":
            raise KeyboardInterrupt

    file = tmp_path / "pid"
    before = dict(os.environ)
    with pytest.raises(KeyboardInterrupt):
        run_in_processes({"sleeping": partial(jobs.sleep, file)}, interrupt, 1)
    assert dict(os.environ) == before
    with pytest.raises(ProcessLookupError):
        os.kill(int(file.read_text()), 0)


def test_an_interrupt_leaves_no_process_that_has_just_started(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    started_processes: list[BaseProcess] = []
    start, end = SpawnProcess.start, threading.Event()

    def interrupted(process: BaseProcess) -> None:
        start(process)
        started_processes.append(process)
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0.1)

    monkeypatch.setattr(SpawnProcess, "start", interrupted)
    other = threading.Thread(
        target=end.wait
    )  # this thread may receive the signal instead of the main one
    other.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_in_processes({"sleeping": partial(jobs.sleep, tmp_path / "pid")}, ignore, 1)
    finally:
        end.set()
        other.join()
    assert [process.exitcode for process in started_processes] == [-signal.SIGTERM]


def test_there_must_be_at_least_one_process() -> None:
    with pytest.raises(GymMaraError, match="processes must be a whole number of at least 1"):
        run_in_processes({}, ignore, 0)


def test_grid_json_holds_the_grid(finished_grid: Path) -> None:
    about = json.loads((finished_grid / "grid.json").read_text())
    assert about["algos"] == ["ppo", "acktr"]
    assert about["preset_name"] == "tuned"
