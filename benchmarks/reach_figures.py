"""The figures of benchmarks/reach.py: learning curves, and heat maps over the workspace."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colorbar import Colorbar
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, StrMethodFormatter
from numpy.typing import NDArray

from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.errors import GymMaraError
from gym_mara.files import written_aside
from gym_mara.tasks import AnyTargetTask
from gym_mara.types import Floats

CELL = 0.1
"""The side of a cell of a heat map, m."""
FEWEST = 3
"""A cell with fewer targets is grey: its median would say little."""
PARTS = 20
"""The window of a line is this part of a training's evaluations."""
SMALLEST = 1e-4
"""Smaller errors, mm or degrees, are drawn as this one, because the scales are logarithmic."""
DARK, GREY = "0.3", "0.85"

Metrics = dict[str, Floats]


class Places(NamedTuple):
    """Where the targets of episodes are."""

    radius: Floats
    """The horizontal distance from the first joint's axis (N,), m."""
    height: Floats
    """In the world frame (N,), m."""


def draw_curves(
    file: Path,
    title: str,
    runs: Sequence[RunFolder],
    task: AnyTargetTask,
    baseline: Metrics | None,
) -> None:
    """Draw the evaluations of trainings against steps: success, position error, and the angle if the task judges it.

    Args:
        file: the picture, which is replaced.
        title: of the picture.
        runs: each has its own colour: a dot for each evaluation, and a line for their means or medians in a window.
        task: its tolerances are drawn.
        baseline: of inverse kinematics; its success is drawn.

    Raises:
        GymMaraError: a run has no evaluations of success, or the file cannot be written.
    """
    panels = {
        "eval/success_percent": ("success, %", None),
        "eval/position_error_mm": ("position error, mm", 1000.0 * task.position_tolerance),
    }
    if task.orientation:
        panels["eval/angle_deg"] = ("angle, deg", float(np.degrees(task.angle_tolerance)))
    figure = Figure(figsize=(7.0, 1.2 + 2.2 * len(panels)), layout="constrained")
    axes: Sequence[Axes] = figure.subplots(len(panels), 1, sharex=True)
    tables = [read_progress(run.progress_file) for run in runs]
    for axis, (column, (label, tolerance)) in zip(axes, panels.items(), strict=True):
        draw_panel(axis, column, tolerance, runs, tables)
        axis.set_ylabel(label)
    axes[0].set_ylim(-4.0, 104.0)
    if baseline is not None:
        success = float(baseline["success_percent"].mean())
        text = "inverse kinematics"
        axes[0].axhline(success, color=DARK, linestyle="--", linewidth=1.2, label=text)
    axes[-1].set_xlim(left=0.0)
    axes[-1].set_xlabel("environment steps")
    axes[-1].xaxis.set_major_formatter(EngFormatter(sep=""))
    named = dict(zip(*reversed(axes[1].get_legend_handles_labels()), strict=True))
    named |= dict(zip(*reversed(axes[0].get_legend_handles_labels()), strict=True))
    figure.suptitle(title)
    figure.legend(
        list(named.values()),
        list(named),
        loc="outside lower center",
        ncols=min(len(named), 5),
        fontsize="small",
        frameon=False,
    )
    save(figure, file)


def draw_panel(
    axis: Axes,
    column: str,
    tolerance: float | None,
    runs: Sequence[RunFolder],
    tables: Sequence[Sequence[Mapping[str, float]]],
) -> None:
    """Draw a column of the tables of progress against steps; errors, which have a tolerance, on a logarithmic scale.

    Raises:
        GymMaraError: a run has no evaluations with this column.
    """
    for number, (run, rows) in enumerate(zip(runs, tables, strict=True)):
        points = [(r["time/total_timesteps"], r[column]) for r in rows if column in r]
        if not points:
            raise GymMaraError(
                f"{str(run.progress_file)!r} has no {column}: give runs that were evaluated in their training"
            )
        steps, values = np.array(points).T
        values = values if tolerance is None else np.maximum(values, SMALLEST)
        smooth = in_windows(values, shares=tolerance is None)
        axis.plot(steps, values, ".", color=f"C{number}", alpha=0.25, markeredgewidth=0.0)
        axis.plot(steps, smooth, color=f"C{number}", label=f"seed {run.config.seed}")
    axis.grid(alpha=0.3)
    if tolerance is not None:
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axis.axhline(tolerance, color=DARK, linestyle=":", linewidth=1.2, label="tolerance")


def in_windows(values: Floats, *, shares: bool) -> Floats:
    """The mean of shares (E,), or the median of errors, in a window around each."""
    half, average = len(values) // PARTS // 2, np.mean if shares else np.median
    windows = (values[max(0, i - half) : i + half + 1] for i in range(len(values)))
    return np.array([average(window) for window in windows])


def draw_workspace(
    file: Path, title: str, places: Places, results: Sequence[Metrics], task: AnyTargetTask
) -> None:
    """Draw heat maps of the median position error and of the share of failures, over where the targets are.

    Args:
        file: the picture, which is replaced.
        title: of the picture.
        places: of the targets.
        results: the metrics of each run in the episodes of these targets; a cell has those of all runs.
        task: its tolerance is marked.

    Raises:
        GymMaraError: no cell has enough targets, or the file cannot be written.
    """
    errors = np.array([each["position_error_mm"] for each in results])
    failed = 100.0 - np.array([each["success_percent"] for each in results])
    median = np.maximum(per_cell(places, errors, np.median), SMALLEST)
    share = per_cell(places, failed, np.mean)
    if np.isnan(median).all():
        raise GymMaraError(
            f"{errors.shape[1]} targets are too few for a heat map: give more --episodes"
        )
    tolerance = 1000.0 * task.position_tolerance
    ends = min(np.nanmin(median), tolerance), max(np.nanmax(median), tolerance)
    low, high = np.floor(np.log10(ends))
    decades = LogNorm(10.0**low, 10.0 ** (high + 1.0))
    tens = Normalize(0.0, max(10.0, 10.0 * np.ceil(np.nanmax(share) / 10.0)))
    figure = Figure(figsize=(8.6, 5.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    bar = heat_map(
        left, places, median, decades, "viridis", "median position error, mm (red line: tolerance)"
    )
    bar.ax.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    bar.ax.axhline(tolerance, color="red", linewidth=1.5)
    heat_map(right, places, share, tens, "YlOrRd", "failures, %")
    left.set_ylabel("height, m")
    seeds, targets = errors.shape
    figure.suptitle(f"{title}: {targets:,} targets, {seeds} seed{'s' * (seeds > 1)}")
    save(figure, file)


def heat_map(
    axis: Axes, places: Places, values: Floats, norm: Normalize, colours: str, label: str
) -> Colorbar:
    """Draw the values of `per_cell`; returns the bar of colours."""
    column, row = first_cell(places)
    rows, columns = values.shape
    edges = CELL * (column + np.arange(columns + 1)), CELL * (row + np.arange(rows + 1))
    drawn = axis.pcolormesh(*edges, values, cmap=colours, norm=norm)
    axis.set_facecolor(GREY)
    axis.set_aspect("equal")
    axis.set_xlabel("distance from the axis of the first joint, m")
    return axis.figure.colorbar(drawn, ax=axis, label=label)


def per_cell(places: Places, values: Floats, average: Callable[[Floats], Any]) -> Floats:
    """The average of the values (S, N) of the targets in each cell (rows of heights, columns of radii); NaN with few targets."""
    first = first_cell(places)
    columns, rows = np.floor(np.array(places) / CELL).astype(int) - first[:, None]
    cells = np.full((rows.max() + 1, columns.max() + 1), np.nan)
    for row, column in set(zip(rows.tolist(), columns.tolist(), strict=True)):
        inside = (rows == row) & (columns == column)
        if inside.sum() >= FEWEST:
            cells[row, column] = average(values[:, inside])
    return cells


def first_cell(places: Places) -> NDArray[np.int64]:
    """The column and the row of the first cell: that of the axis, and that of the lowest target."""
    return np.array([0, np.floor(places.height.min() / CELL)], np.int64)


def save(figure: Figure, file: Path) -> None:
    """Write a figure; a file that exists is replaced."""
    with written_aside(file) as aside:
        figure.savefig(aside, dpi=110)
