"""The pictures and tables of runs that reach any target: one command makes them, and runs that do not fit are named."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from gym_mara.agents.evaluation.episodes import episode_seeds
from gym_mara.agents.evaluation.metrics import METRICS
from gym_mara.agents.evaluation.rollout import roll_out
from gym_mara.agents.runs.evaluation import make_arms
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training.train import train
from gym_mara.errors import GymMaraError
from gym_mara.tasks import AnyTargetTask
from tests.agents.conftest import config, shorten_episodes, silent
from tests.helpers import write

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
TRAVELLING = {"max_joint_velocity": 1.57, "servo_gain": 10.0}


@pytest.fixture
def reach(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script that makes the pictures and tables, with short films of small pictures."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    module = importlib.import_module("reach")
    monkeypatch.setattr(module, "TARGETS", 2)
    monkeypatch.setattr(module, "FILM", {"width": 160, "height": 120})
    return module


@pytest.mark.slow
def test_one_command_makes_the_pictures_and_tables_of_runs_that_reach_any_target(
    reach: ModuleType,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    shorten_episodes(monkeypatch, 60)
    folders, out = [tmp_path / name for name in "abc"], tmp_path / "results"
    runs = zip(("MARAReach-v0", "MARAReach-v0", "MARAPose-v0"), (0, 1, 0), folders, strict=True)
    for env, seed, folder in runs:
        train(config(env=env, seed=seed, steps=1, env_options=TRAVELLING), folder, silent)
    out.mkdir()
    write(out / "MARAReach-v0.gif", "an older film")
    small = ["--backend", "pinocchio", "mujoco", "--set", "threads=1", "--episodes", "60"]
    command = ["reach.py", *map(str, folders), "--out", str(out), *small]
    monkeypatch.setattr(sys, "argv", command)
    reach.main()
    text = capsys.readouterr().out
    endings = ("_curves.png", "_workspace.png", ".gif")
    names = {f"{env}{ending}" for env in ("MARAReach-v0", "MARAPose-v0") for ending in endings}
    assert {path.name for path in out.iterdir()} == names
    assert set(re.findall(r"\(results/(.*)\)", text)) == names
    for name in names:
        with Image.open(out / name) as picture:
            assert len(picture.convert("RGB").getcolors(10**6) or ()) > 20, "something is drawn"
    tables = [
        [[cell.strip() for cell in line.split("|")[1:-1]] for line in part.splitlines()]
        for part in text.split("\n\n")
        if part.startswith("|")
    ]
    assert [table[0][0] for table in tables] == 2 * [
        f"60 episodes, seed 0, `{backend}`" for backend in ("pinocchio", "mujoco")
    ]
    two, one = (
        ["seed 0", "seed 1", "median", "inverse kinematics"],
        ["seed 0", "inverse kinematics"],
    )
    assert [table[0][1:] for table in tables] == [two, two, one, one]
    for table in tables:
        assert {len(cells) for cells in table} == {len(table[0])}
        assert len(table) == 2 + (len(reach.ROWS) if table[0][1:] == one else len(reach.ROWS) - 2)


def _metrics(value: float, **others: Any) -> dict[str, Any]:
    return {name: np.full(4, value) for name in METRICS} | others


def test_a_table_has_the_median_of_the_seeds_that_have_a_value(reach: ModuleType) -> None:
    never = np.full(4, np.nan)
    runs = [_metrics(1.0, tremble_mm=np.arange(4.0)), _metrics(9.0, settling_ratio=never)]
    played = reach.Played([*runs, _metrics(2.0, settling_ratio=never)], _metrics(0.5))
    rows = dict(
        line.strip("| ").split(" | ", 1)
        for line in reach.table("corner", [3, 4, 5], played, AnyTargetTask())
        if "---" not in line
    )
    assert rows["corner"] == "seed 3 | seed 4 | seed 5 | median | inverse kinematics"
    assert rows["success"] == "1.0 % | 9.0 % | 2.0 % | 2.0 % | 0.5 %"
    assert rows["settling time relative to the least"].split(" | ")[1:4] == [
        "-",
        "-",
        "1.000, 1.000, 1.000",
    ]
    assert rows["tremble, mm"].split(" | ")[0] == "1.500, 1.500, 2.850"
    assert not any(title.startswith("angle") for title in rows)


def test_the_places_of_a_heat_map_are_those_of_the_evaluated_targets(
    reach: ModuleType, tmp_path: Path
) -> None:
    run = RunFolder(tmp_path, config(env="MARAReach-v0"))
    asked = argparse.Namespace(episodes=4, seed=3, backend=[], options={})
    _, places = reach.targets(run, "pinocchio", asked)
    arms = make_arms("MARAReach-v0", "pinocchio", 2, {}, max_episode_steps=None)
    still = np.zeros((2, 6))
    seeds = [episode_seeds(3, first, 2) for first in (0, 2)]
    target = np.concatenate([roll_out(arms, lambda _: lambda _: still, s, 1).target for s in seeds])
    arms.close()
    np.testing.assert_array_equal(places.height, target[:, 2])
    np.testing.assert_allclose(places.radius, np.hypot(target[:, 0], target[:, 1]), atol=1e-12)


def test_a_cell_of_a_heat_map_has_the_values_of_all_seeds(reach: ModuleType) -> None:
    figures = importlib.import_module("reach_figures")
    radius, height = np.array([0.05, 0.07, 0.01, 0.31]), np.array([0.62, 0.63, 0.69, 0.75])
    values = np.array([[1.0, 2.0, 3.0, 9.0], [4.0, 5.0, 6.0, 9.0]])
    cells = figures.per_cell(figures.Places(radius, height), values, np.median)
    assert cells.shape == (2, 4)
    assert cells[0, 0] == 3.5
    assert np.isnan(cells[1, 3]), "one target is not enough"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"env": "MARA-v0"}, "is a run of MARA-v0: give runs of MARAReach-v0 and MARAPose-v0"),
        ({"seed": 5}, "have the same seed, 5: give each seed once"),
        ({"algo": "trpo"}, "differ in algo, 'ppo' and 'trpo': give runs that differ in their seed"),
        ({"env_options": TRAVELLING}, "differ in env_options"),
    ],
)
def test_runs_that_do_not_fit_together_are_named(
    reach: ModuleType, tmp_path: Path, changes: dict[str, Any], message: str
) -> None:
    one = config(env="MARAReach-v0", seed=5)
    other = config(**({"env": "MARAReach-v0", "seed": 6} | changes))
    runs = [RunFolder(tmp_path / name, each) for name, each in (("a", one), ("b", other))]
    for run in runs:
        (run.path / "last").mkdir(parents=True)
        write(run.path / "last" / "model.zip", "")
    with pytest.raises(GymMaraError, match=message):
        reach.grouped(runs, "last")
    with pytest.raises(GymMaraError, match="no 'best' policy"):
        reach.grouped(runs[:1], "best")
