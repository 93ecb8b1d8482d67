"""The learning curve of a run as a picture."""

from __future__ import annotations

import contextlib
from pathlib import Path

import pytest
from matplotlib.figure import Figure

from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.training import learning_curve as module
from gym_mara.agents.training.learning_curve import plot_learning_curve
from gym_mara.errors import GymMaraError
from tests.agents.conftest import config

PROGRESS = (
    "time/total_timesteps,rollout/reward_per_step,eval/reward_per_step,eval/position_error_mm\n"
    "512,1.0,,\n1024,2.0,3.0,80.0\n"
)


@pytest.fixture
def run(tmp_path: Path) -> RunFolder:
    """A run with a table of progress."""
    run = RunFolder(tmp_path, config())
    run.progress_file.write_text(PROGRESS)
    return run


def test_a_learning_curve_is_a_picture(run: RunFolder) -> None:
    assert plot_learning_curve(run).read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(("env", "lines"), [("MARA-v0", 3), ("MARAReach-v0", 2)])
def test_only_the_tasks_of_the_paper_have_a_line_at_their_best_reward(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch, env: str, lines: int
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    monkeypatch.setattr(module, "written_aside", contextlib.nullcontext)
    plot_learning_curve(RunFolder(run.path, config(env=env)))
    assert len(drawn[0].axes[0].lines) == lines


def test_a_task_without_a_position_error_has_no_panel_for_it(
    run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *_, **__: drawn.append(figure))
    monkeypatch.setattr(module, "written_aside", contextlib.nullcontext)
    plot_learning_curve(run)
    run.progress_file.write_text(PROGRESS.replace("position_error_mm", "angle_deg"))
    plot_learning_curve(run)
    assert [len(figure.axes) for figure in drawn] == [2, 1]


def test_a_file_size_limit_leaves_the_old_picture(run: RunFolder, small_files: None) -> None:
    picture = run.path / "learning_curve.png"
    picture.write_text("old")
    with pytest.raises(GymMaraError, match=r"cannot write .*learning_curve.png.*File too large"):
        plot_learning_curve(run)
    assert picture.read_text() == "old"
    assert len(list(run.path.iterdir())) == 2, "and no other file"
