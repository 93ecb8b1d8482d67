"""The learning curve of a run as an image file."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.files import written_aside
from gym_mara.registration import is_of_paper


def plot_learning_curve(run: RunFolder) -> Path:
    """Draw rewards and position error against steps into `learning_curve.png`; returns its path."""
    rows = read_progress(run.progress_file)
    figure = Figure(figsize=(7.0, 6.0), layout="constrained")
    reward, error = figure.subplots(2, 1, sharex=True)

    def draw(axis: object, column: str, label: str, style: str) -> None:
        points = [(r["time/total_timesteps"], r[column]) for r in rows if column in r]
        axis.plot(*zip(*points, strict=True), style, label=label)  # type: ignore[attr-defined]

    draw(reward, "rollout/reward_per_step", "training", "C0-")
    draw(reward, "eval/reward_per_step", "deterministic policy", "C1o-")
    if is_of_paper(run.config.env):
        reward.axhline(10.0, color="grey", linewidth=0.8, linestyle=":")
    reward.set_ylabel("reward per step")
    reward.legend(loc="best")
    draw(error, "eval/position_error_mm", "deterministic policy, last step", "C1o-")
    error.set_yscale("log")
    error.set_ylabel("position error, mm")
    error.set_xlabel("environment steps")
    config = run.config
    figure.suptitle(f"{config.algo.upper()} on {config.env}, {config.backend}, seed {config.seed}")
    file = run.path / "learning_curve.png"
    with written_aside(file) as aside:
        figure.savefig(aside, dpi=120)
    return file
