"""The files of a grid: what is damaged or hostile is refused, and a figure is replaced as a whole or not at all."""

from __future__ import annotations

import contextlib
import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from gym_mara.agents.evaluation.metrics import METRICS
from gym_mara.agents.experiments import figures
from gym_mara.agents.experiments import grid as grid_module
from gym_mara.agents.experiments.figures import _markdown, _rows, _scale, plot_grid
from gym_mara.agents.experiments.grid import Grid, Metrics, open_grid, read_result, valid_result
from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.errors import GymMaraError

GRID = Grid(envs=("MARA-v0",), algos=("ppo", "acktr"), seeds=1, steps=4096)
POLICY = {
    "position_error_mm": 1.0,
    "angle_deg": 2.0,
    "success_percent": None,
    "reward_per_step": 9.0,
    "return": 100.0,
    "collisions": 0.0,
}
RESULT: dict[str, Any] = {
    "episodes": 1,
    "last": POLICY,
    "best": POLICY,
    "steps_to_10_mm": None,
    "seconds": 3,
}
PROGRESS = "time/total_timesteps,rollout/reward_per_step\n2048,1.0\n4096,9.9\n"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A finished grid."""
    folder = tmp_path / "grid"
    open_grid(folder, GRID)
    for name in GRID.runs():
        (folder / name).mkdir()
        (folder / name / "progress.csv").write_text(PROGRESS)
        (folder / name / "result.json").write_text(json.dumps(RESULT))
    return folder


def names(folder: Path) -> set[str]:
    """The names of the files of a folder."""
    return {entry.name for entry in folder.iterdir()}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"envs": ["../victim"]}, "unknown environment '../victim'"),
        ({"envs": []}, "at least one environment"),
        ({"envs": ["MARA-v0", "MARA-v0"]}, "each name once"),
        ({"algos": "ppo"}, "algos: .*array|tuple"),
        ({"algos": ["ppo/../ppo"]}, "unknown algorithm"),
        ({"preset_name": "../tuned"}, "preset"),
        ({"backend": "gazebo"}, "unknown backend"),
        ({"seeds": 10**9}, "seeds must be at most 1,000, not 1000000000"),
        ({"seeds": 1.5}, "seeds: .*integer"),
        ({"steps": 10**400}, "steps must be at most"),
        ({"steps": True}, "steps: .*integer"),
        ({"checkpoint_every": 0}, "checkpoint_every must be"),
        ({"presets": ["tuned"]}, "presets: .*object|dict"),
        ({"presets": {"ppo": 1}}, "presets.ppo"),
        ({"more": 1}, "more: Unexpected"),
    ],
)
def test_a_hostile_grid_is_refused_and_nothing_is_written(
    folder: Path, change: dict[str, Any], message: str
) -> None:
    file = folder / "grid.json"
    file.write_text(json.dumps({**json.loads(file.read_text()), **change}))
    before = names(folder), names(folder.parent)
    for use in (plot_grid, lambda folder: open_grid(folder, GRID)):
        with pytest.raises(GymMaraError, match=message) as caught:
            use(folder)
        assert "grid.json" in str(caught.value)
    assert (names(folder), names(folder.parent)) == before


def test_a_pipe_or_a_link_to_a_device_is_no_grid(tmp_path: Path) -> None:
    for make in (os.mkfifo, lambda file: os.symlink("/dev/zero", file)):
        (folder := tmp_path / make.__name__).mkdir()
        make(folder / "grid.json")
        with pytest.raises(GymMaraError, match=r"grid.json.*not a plain file"):
            plot_grid(folder)
        with pytest.raises(GymMaraError, match=r"grid.json.*not a plain file"):
            open_grid(folder, GRID)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (json.dumps({**RESULT, "seconds": "0.001"}), "seconds: .*number, not '0.001'"),
        (json.dumps({**RESULT, "seconds": -1.0}), "seconds: .*greater"),
        (json.dumps({**RESULT, "last": {**POLICY, "return": float("nan")}}), "last.return"),
        (
            json.dumps({k: v for k, v in RESULT.items() if k != "episodes"}),
            "episodes: Field required",
        ),
        (json.dumps({**RESULT, "best": {}}), "best.position_error_mm: Field required"),
        (json.dumps({**RESULT, "steps_to_10_mm": 1.5}), "steps_to_10_mm"),
        (json.dumps(RESULT)[:-9], "JSON"),
        (100_000 * "[", "JSON"),
        ("\x00", "JSON"),
    ],
)
def test_a_damaged_result_is_named_and_never_averaged(
    folder: Path, text: str, message: str
) -> None:
    file = folder / "MARA-v0_ppo_0" / "result.json"
    file.write_text(text)
    assert valid_result(file.parent) is None
    with pytest.raises(GymMaraError, match=rf"MARA-v0_ppo_0/result.json.*{message}.*again"):
        plot_grid(folder)


def test_a_result_has_metrics_of_the_evaluation(folder: Path) -> None:
    assert Metrics.__annotations__.keys() <= METRICS.keys()
    assert read_result(folder / "MARA-v0_ppo_0") == RESULT


def test_a_metric_that_a_task_does_not_measure_is_a_dash(folder: Path) -> None:
    for name in GRID.runs():
        unmeasured = {**RESULT, "last": {**POLICY, "position_error_mm": None}}
        (folder / name / "result.json").write_text(json.dumps(unmeasured))
    plot_grid(folder)
    assert "| MARA-v0 | PPO | 1 | - | - |" in (folder / "table.md").read_text()


@pytest.mark.parametrize(("env", "episodes"), [("MARA-v0", 1), ("MARAReach-v0", 100)])
def test_a_policy_is_measured_in_many_episodes_where_they_are_random(
    env: str, episodes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    played: list[int] = []

    def evaluate(run: RunFolder, *, episodes: int, which: str) -> dict[str, Any]:
        played.append(episodes)
        return {name: np.ones(episodes) for name in METRICS}

    monkeypatch.setattr(grid_module, "evaluate_run", evaluate)
    monkeypatch.setattr(RunFolder, "has_policy", lambda *_: True)
    run = RunFolder(tmp_path, RunConfig(env, "ppo", "pinocchio", 4096, 0))
    run.progress_file.write_text(PROGRESS)
    assert grid_module._result(run)["episodes"] == episodes
    assert played == [episodes, episodes]


def test_the_success_is_a_column_where_a_task_reports_it() -> None:
    def table_of(last: dict[str, Any]) -> str:
        results: dict[str, Any] = {name: {**RESULT, "last": last} for name in GRID.runs()}
        return _markdown(list(_rows(GRID, results)))

    assert "success" not in table_of(POLICY)
    table = table_of({**POLICY, "success_percent": 62.0}).splitlines()
    column = table[0].split(" | ").index("success, %")
    assert table[2].split(" | ")[column] == "62.0"


def test_a_file_size_limit_leaves_the_old_figures(folder: Path, small_files: None) -> None:
    (folder / "MARA-v0.png").write_text("old")
    before = names(folder)
    with pytest.raises(GymMaraError, match=r"cannot write .*MARA-v0.png.*File too large"):
        plot_grid(folder)
    assert (folder / "MARA-v0.png").read_text() == "old"
    assert names(folder) == before


def test_a_figure_never_follows_a_link_out_of_the_folder(folder: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    for name in ("MARA-v0.png", "table.md", "curves.csv"):
        (folder / name).symlink_to(victim)
    plot_grid(folder)
    assert victim.read_text() == "mine"
    assert not (folder / "MARA-v0.png").is_symlink()


def test_curves_close_to_the_best_are_far_apart_in_the_figure() -> None:
    axis = Figure().subplots()
    assert "logarithmic" in _scale(axis, np.array([-2000.0, 20_410.0, 20_470.0]))
    _, low, high, top = axis.transAxes.inverted().transform(
        axis.transData.transform([(0.0, y) for y in (-2000.0, 20_410.0, 20_470.0, 20_475.0)])
    )[:, 1]
    assert 0.4 < low < high - 0.1
    assert high < top


@pytest.mark.parametrize(
    ("env", "label"),
    [("MARA-v0", "mean episode reward"), ("MARAReach-v0", "mean reward per step in training")],
)
def test_only_the_figures_of_the_paper_show_whole_episodes(
    env: str, label: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    monkeypatch.setattr(figures, "written_aside", lambda file: contextlib.nullcontext(file))
    rows = [{"time/total_timesteps": 4096.0, "rollout/reward_per_step": -0.1}]
    grid = replace(GRID, envs=(env,))
    figures._draw(tmp_path / "x.png", grid, env, ["ppo"], {f"{env}_ppo_0": rows})
    (axis,) = drawn[-1].axes
    assert axis.get_ylabel().startswith(label)
    factor = 2048.0 if env == "MARA-v0" else 1.0
    np.testing.assert_allclose(np.asarray(axis.lines[0].get_ydata()), -0.1 * factor)


def test_curves_far_from_the_best_fill_the_figure() -> None:
    axis = Figure().subplots()
    axis.plot([0.0, 1.0], [-2000.0, 1000.0])
    assert _scale(axis, np.array([-2000.0, 1000.0])) == ""
    assert axis.get_ylim()[1] < 1500.0
