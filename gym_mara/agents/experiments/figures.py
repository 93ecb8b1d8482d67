"""The results of a grid, as figures and as tables."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, StrMethodFormatter
from scipy.stats import bootstrap, trim_mean

from gym_mara.agents.experiments.grid import Grid, Result, read_grid, read_result
from gym_mara.agents.runs.folder import DamagedRunError, read_progress
from gym_mara.errors import GymMaraError
from gym_mara.files import write_text, written_aside
from gym_mara.registration import environment, file_name, is_of_paper
from gym_mara.tasks import MAX_EPISODE_STEPS, named_task
from gym_mara.types import Floats

# Column of the table → where a result holds its value, and how many digits are printed.
COLUMNS: dict[str, tuple[tuple[str, ...], int]] = {
    "position error, mm": (("last", "position_error_mm"), 4),
    "angle, deg": (("last", "angle_deg"), 2),
    "success, %": (("last", "success_percent"), 1),
    "reward per step": (("last", "reward_per_step"), 2),
    "collisions": (("last", "collisions"), 0),
    "position error of the best, mm": (("best", "position_error_mm"), 4),
    "angle of the best, deg": (("best", "angle_deg"), 2),
    "steps to 10 mm": (("steps_to_10_mm",), 0),
    "wall time, s": (("seconds",), 0),
}
_OPTIONAL = "success, %"
"""The column that only tables with a task that reports `success` have."""
_TRAINING, _EVALUATION = "rollout/reward_per_step", "eval/reward_per_step"
_POINTS = 200
_BEST = 10.0 * MAX_EPISODE_STEPS
"""The highest reward of an episode of the paper's tasks."""


@dataclass(frozen=True)
class Interval:
    """The interquartile mean over the seeds, and the 95 % bootstrap interval around it."""

    mean: float
    low: float
    high: float


def interquartile_mean(values: Sequence[float]) -> Interval:
    """The mean of the middle half of the values (of all, where there are fewer than four), with its interval.

    An infinite value stands for something that a run never reached. If it is among the averaged values, the mean is infinite.
    """
    data = np.asarray(values, np.float64)
    centre = float(trim_mean(data, 0.25))
    if len(data) < 2 or not np.isfinite(data).all() or np.ptp(data) == 0.0:
        return Interval(centre, float(data.min()), float(data.max()))
    drawn = bootstrap(
        (data,),
        lambda sample, axis: trim_mean(sample, 0.25, axis=axis),
        method="percentile",
        rng=np.random.default_rng(0),
    ).confidence_interval
    return Interval(centre, float(drawn.low), float(drawn.high))


def plot_grid(folder: Path) -> list[Path]:
    """Draw the figures of a grid into its folder, with its table and curves; returns the files.

    For each environment there is a figure of all algorithms, ENV.png, and one of each algorithm alone, ENV_ALGO.png. The
    tables are `table.md`, `table.csv` and `curves.csv`. Runs that have not finished are left out. A file is replaced when
    its successor is complete.

    Raises:
        GymMaraError: the folder holds no grid, none of its runs has finished, a finished run is damaged, or a file cannot
            be written.
    """
    grid = read_grid(folder)
    runs = grid.runs()
    results = {name: result for name in runs if (result := read_result(folder / name)) is not None}
    if not results:
        raise GymMaraError(f"no run of the grid {str(folder)!r} has finished")
    curves = {name: _curve(folder / name) for name in results}
    files = []
    for env in grid.envs:
        of_env = {runs[name].algo for name in results if runs[name].env == env}
        finished = [algo for algo in grid.algos if algo in of_env]
        if finished:
            files.append(_draw(folder / f"{file_name(env)}.png", grid, env, grid.algos, curves))
        for algo in finished:
            files.append(_draw(folder / f"{file_name(env)}_{algo}.png", grid, env, [algo], curves))
    files.append(_write_curves(folder / "curves.csv", grid, curves))
    rows = list(_rows(grid, results))
    files.append(_write_table(folder / "table.csv", rows))
    write_text(folder / "table.md", _markdown(rows))
    return [*files, folder / "table.md"]


def _curve(path: Path) -> list[dict[str, float]]:
    """A finished run's table of progress.

    Raises:
        DamagedRunError: it is missing or damaged; the message says how to train the run again.
    """
    try:
        rows = read_progress(path / "progress.csv")
        if any(_TRAINING in row for row in rows):
            return rows
        raise DamagedRunError("it holds no training rewards")
    except (OSError, GymMaraError) as error:
        raise DamagedRunError(
            f"the finished run {str(path)!r} is damaged: progress.csv: {error}; "
            "move the folder away and run the same benchmark command to train it again"
        ) from error


def _draw(
    file: Path,
    grid: Grid,
    env: str,
    algos: Sequence[str],
    curves: dict[str, list[dict[str, float]]],
) -> Path:
    """Mean reward against steps: of an episode for the paper's tasks, per step for others.

    Each algorithm has a colour. One that is alone also has a line for each seed.
    """
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axis = figure.subplots()
    steps = np.linspace(0, grid.steps, _POINTS + 1)[1:]
    drawn = []
    of_paper = is_of_paper(env)
    factor = MAX_EPISODE_STEPS if of_paper else 1
    for algo in algos:
        names = [name for name, run in grid.runs().items() if (run.env, run.algo) == (env, algo)]
        lines = [factor * _mean_reward(curves[name], steps) for name in names if name in curves]
        if lines:
            colour = f"C{grid.algos.index(algo)}"
            drawn.append(_draw_band(axis, steps, np.array(lines), algo, colour, len(algos) == 1))
    if of_paper:
        axis.set_ylabel("mean episode reward in training" + _scale(axis, np.concatenate(drawn)))
    else:
        axis.set_ylabel("mean reward per step in training")
    axis.set_xlabel("environment steps")
    axis.set_title(f"{env}, {grid.preset_name} presets, {grid.backend}")
    axis.legend(loc="best")
    with written_aside(file) as aside:
        figure.savefig(aside, dpi=110)
    return file


def _draw_band(
    axis: Axes, steps: Floats, lines: Floats, algo: str, colour: str, alone: bool
) -> Floats:
    """Draw the mean and the deviation of the lines of some seeds; returns what the axis must show."""
    mean, deviation = lines.mean(axis=0), lines.std(axis=0)
    of = f"mean and deviation of {len(lines)} seeds" if len(lines) > 1 else "one seed"
    axis.plot(steps, mean, color=colour, label=f"{algo.upper()}, {of}")
    axis.fill_between(
        steps, mean - deviation, mean + deviation, color=colour, alpha=0.2, linewidth=0
    )
    if alone:
        for line in lines:
            axis.plot(steps, line, color=colour, linewidth=0.5, alpha=0.6)
    return lines.ravel() if alone else mean


def _scale(axis: Axes, shown: Floats) -> str:
    """Scale the axis of rewards so that curves close to the best can be told apart; returns what to add to its label.

    The distance from the best is logarithmic where it spans more than one decade.
    """
    distance = np.array([_BEST - shown.max(), _BEST - shown.min()])
    if not 0.0 < 10.0 * distance[0] < distance[1]:
        return ""
    least, most = distance * [0.8, 1.25]

    def forward(reward: Floats) -> Floats:
        return -np.log10(np.maximum(_BEST - reward, least / 10.0))

    def inverse(scaled: Floats) -> Floats:
        rewards: Floats = _BEST - 10.0**-scaled
        return rewards

    axis.set_yscale("function", functions=(forward, inverse))
    axis.set_ylim(_BEST - most, _BEST - least)
    decades = 10.0 ** np.arange(np.floor(np.log10(least)), np.ceil(np.log10(most)))
    axis.yaxis.set_major_locator(FixedLocator(list(_BEST - decades)))
    axis.yaxis.set_minor_locator(
        FixedLocator(list(_BEST - np.outer(decades, range(2, 10)).ravel()))
    )
    axis.yaxis.set_major_formatter(StrMethodFormatter("{x:,.10g}"))
    axis.grid(axis="y", alpha=0.3)
    return f",\nlogarithmic in the distance from {_BEST:,.0f}, the best"


def _mean_reward(rows: list[dict[str, float]], steps: Floats) -> Floats:
    """The mean reward per step since the number before, at these numbers of steps."""
    points = [(r["time/total_timesteps"], r[_TRAINING]) for r in rows if _TRAINING in r]
    x, y = (np.array(column) for column in zip(*points, strict=True))
    part = np.searchsorted(steps, x).clip(max=len(steps) - 1)
    count = np.bincount(part, minlength=len(steps))
    mean = np.bincount(part, y, len(steps)) / np.maximum(count, 1)
    there = count > 0
    filled: Floats = np.interp(steps, steps[there], mean[there])
    return filled


def _write_curves(file: Path, grid: Grid, curves: dict[str, list[dict[str, float]]]) -> Path:
    """Write all curves, sampled at the same steps, and the results of the evaluations during training."""
    steps = np.linspace(0, grid.steps, _POINTS + 1)[1:]
    evaluated = (_EVALUATION, "eval/position_error_mm", "eval/angle_deg")
    table: list[list[Any]] = [["env", "algo", "seed", "steps", _TRAINING, *evaluated]]
    for name, run in grid.runs().items():
        rows = curves.get(name, [])
        start = [run.env, run.algo, run.seed]
        for step, reward in zip(steps, _mean_reward(rows, steps) if rows else (), strict=False):
            cells = [f"{int(step)}", f"{reward:.4f}"]
            table.append([*start, *cells, "", "", ""])
        for row in rows:
            if _EVALUATION in row:
                cells = [f"{row[column]:.5g}" if column in row else "" for column in evaluated]
                table.append([*start, row["time/total_timesteps"], "", *cells])
    return _write_csv(file, table)


def _write_csv(file: Path, table: list[list[Any]]) -> Path:
    text = io.StringIO()
    csv.writer(text).writerows(table)
    write_text(file, text.getvalue())
    return file


def _rows(grid: Grid, results: dict[str, Result]) -> Iterator[dict[str, Any]]:
    """A row for each environment and algorithm."""
    for env in grid.envs:
        for algo in grid.algos:
            runs = [
                results[name]
                for name, run in grid.runs().items()
                if (run.env, run.algo) == (env, algo) and name in results
            ]
            if not runs:
                continue
            row: dict[str, Any] = {"environment": env, "algorithm": algo, "seeds": len(runs)}
            for title, (path, digits) in COLUMNS.items():
                values = [_value(run, path) for run in runs]
                if "angle" in title and not getattr(
                    named_task(environment(env).task), "orientation", False
                ):
                    values = [math.inf]  # the task does not judge the angle
                row[title] = interquartile_mean(values), digits
            yield row


def _value(result: Result, path: tuple[str, ...]) -> float:
    value: Any = result
    for key in path:
        value = value[key]
    return float("inf") if value is None else float(value)


def _columns(rows: list[dict[str, Any]]) -> list[str]:
    """The columns of a table with these rows."""
    measured = any(np.isfinite(row[_OPTIONAL][0].mean) for row in rows)
    return [title for title in COLUMNS if measured or title != _OPTIONAL]


def _write_table(file: Path, rows: list[dict[str, Any]]) -> Path:
    columns = _columns(rows)
    titles = [f"{title}, {part}" for title in columns for part in ("iqm", "low", "high")]
    table: list[list[Any]] = [["environment", "algorithm", "seeds", *titles]]
    for row in rows:
        cells = [f"{v:.6g}" for title in columns for v in asdict(row[title][0]).values()]
        table.append([row["environment"], row["algorithm"], row["seeds"], *cells])
    return _write_csv(file, table)


def _markdown(rows: list[dict[str, Any]]) -> str:
    columns = _columns(rows)
    titles = ["environment", "algorithm", "seeds", *columns]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for row in rows:
        cells = [row["environment"], row["algorithm"].upper(), str(row["seeds"])]
        cells += [format_interval(*row[title]) for title in columns]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def format_interval(interval: Interval, digits: int) -> str:
    """An interval as a cell of a table; a dash if the mean is infinite."""
    if not np.isfinite(interval.mean):
        return "-"
    if interval.mean >= 1.0:
        digits = min(digits, 2)
    mean, low, high = (f"{value:,.{digits}f}" for value in asdict(interval).values())
    return mean if low == high else f"{mean} [{low}, {high}]"
