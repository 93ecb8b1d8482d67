"""The learning curve of a run as an image file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.files import written_aside
from gym_mara.registration import is_of_paper

_ERROR = "eval/position_error_mm"


def plot_learning_curve(run: RunFolder) -> Path:
    """Draw rewards, and the position error where the task has one, against steps into `learning_curve.png`; returns its path."""
    rows = read_progress(run.progress_file)
    positions = any(_ERROR in row for row in rows)
    figure = Figure(figsize=(7.0, 6.0 if positions else 3.5), layout="constrained")
    axes = figure.subplots(1 + positions, 1, sharex=True, squeeze=False)[:, 0]
    reward = axes[0]

    def draw(axis: Axes, column: str, label: str, style: str) -> None:
        points = np.array(
            [(r["time/total_timesteps"], r[column]) for r in rows if column in r]
        ).reshape(-1, 2)
        axis.plot(points[:, 0], points[:, 1], style, label=label)

    draw(reward, "rollout/reward_per_step", "training", "C0-")
    draw(reward, "eval/reward_per_step", "deterministic policy", "C1o-")
    if is_of_paper(run.config.env):
        reward.axhline(10.0, color="grey", linewidth=0.8, linestyle=":")
    reward.set_ylabel("reward per step")
    reward.legend(loc="best")
    if positions:
        draw(axes[1], _ERROR, "deterministic policy, last step", "C1o-")
        axes[1].set_yscale("log")
        axes[1].set_ylabel("position error, mm")
    axes[-1].set_xlabel("environment steps")
    config = run.config
    figure.suptitle(f"{config.algo.upper()} on {config.env}, {config.backend}, seed {config.seed}")
    file = run.path / "learning_curve.png"
    with written_aside(file) as aside:
        figure.savefig(aside, dpi=120)
    return file
