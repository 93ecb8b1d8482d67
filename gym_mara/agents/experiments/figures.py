"""The results of a grid, as figures and as tables."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.stats import bootstrap, trim_mean

from gym_mara.agents.experiments.grid import Grid, read_grid, read_result
from gym_mara.agents.runs.folder import DamagedRunError, read_progress
from gym_mara.errors import GymMaraError
from gym_mara.tasks import MAX_EPISODE_STEPS, named_task
from gym_mara.types import Floats

# Column of the table → where a result holds its value, and how many digits are printed.
COLUMNS: dict[str, tuple[tuple[str, ...], int]] = {
    "position error, mm": (("last", "position_error_mm"), 4),
    "angle, deg": (("last", "angle_deg"), 2),
    "reward per step": (("last", "reward_per_step"), 2),
    "collisions": (("last", "collisions"), 0),
    "position error of the best, mm": (("best", "position_error_mm"), 4),
    "angle of the best, deg": (("best", "angle_deg"), 2),
    "steps to 10 mm": (("steps_to_10_mm",), 0),
    "wall time, s": (("seconds",), 0),
}
_TRAINING, _EVALUATION = "rollout/reward_per_step", "eval/reward_per_step"
_POINTS = 200


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
    tables are `table.md`, `table.csv` and `curves.csv`. Runs that have not finished are left out.

    Raises:
        GymMaraError: the folder holds no grid, or none of its runs has finished.
    """
    grid = read_grid(folder)
    results = {
        name: result for name in grid.runs() if (result := read_result(folder / name)) is not None
    }
    if not results:
        raise GymMaraError(f"no run of the grid {str(folder)!r} has finished")
    curves = {name: _curve(folder / name) for name in results}
    files = []
    for env in grid.envs:
        runs = [grid.runs()[name] for name in results]
        finished = [a for a in grid.algos if any((r.env, r.algo) == (env, a) for r in runs)]
        if finished:
            files.append(_draw(folder / f"{env}.png", grid, env, grid.algos, curves))
        for algo in finished:
            files.append(_draw(folder / f"{env}_{algo}.png", grid, env, [algo], curves))
    files.append(_write_curves(folder / "curves.csv", grid, curves))
    rows = list(_rows(grid, results))
    files.append(_write_table(folder / "table.csv", rows))
    (folder / "table.md").write_text(_markdown(rows))
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
    except (OSError, DamagedRunError) as error:
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
    """Mean episode reward against steps, a colour for each algorithm; one that is alone also has a line for each seed."""
    figure = Figure(figsize=(7.0, 4.5), layout="constrained")
    axis = figure.subplots()
    steps = np.linspace(0, grid.steps, _POINTS + 1)[1:]
    for algo in algos:
        names = [name for name, run in grid.runs().items() if (run.env, run.algo) == (env, algo)]
        lines = [_episode_reward(curves[name], steps) for name in names if name in curves]
        if lines:
            _draw_band(
                axis, steps, np.array(lines), algo, f"C{grid.algos.index(algo)}", len(algos) == 1
            )
    axis.axhline(10.0 * MAX_EPISODE_STEPS, color="grey", linewidth=0.8, linestyle=":")
    axis.set_xlabel("environment steps")
    axis.set_ylabel("mean episode reward in training")
    axis.set_title(f"{env}, {grid.preset_name} presets, {grid.backend}")
    axis.legend(loc="best")
    figure.savefig(file, dpi=110)
    return file


def _draw_band(
    axis: Axes,
    steps: Floats,
    lines: Floats,
    algo: str,
    colour: str,
    alone: bool,
) -> None:
    mean, deviation = lines.mean(axis=0), lines.std(axis=0)
    of = f"mean and deviation of {len(lines)} seeds" if len(lines) > 1 else "one seed"
    axis.plot(steps, mean, color=colour, label=f"{algo.upper()}, {of}")
    axis.fill_between(
        steps, mean - deviation, mean + deviation, color=colour, alpha=0.2, linewidth=0
    )
    if alone:
        for line in lines:
            axis.plot(steps, line, color=colour, linewidth=0.5, alpha=0.6)


def _episode_reward(rows: list[dict[str, float]], steps: Floats) -> Floats:
    """The reward of a whole episode at these numbers of steps, from the mean reward per step since the number before."""
    points = [(r["time/total_timesteps"], r[_TRAINING]) for r in rows if _TRAINING in r]
    x, y = (np.array(column) for column in zip(*points, strict=True))
    part = np.searchsorted(steps, x).clip(max=len(steps) - 1)
    count = np.bincount(part, minlength=len(steps))
    mean = np.bincount(part, y, len(steps)) / np.maximum(count, 1)
    there = count > 0
    filled: Floats = np.interp(steps, steps[there], mean[there])
    return MAX_EPISODE_STEPS * filled


def _write_curves(file: Path, grid: Grid, curves: dict[str, list[dict[str, float]]]) -> Path:
    """Write all curves, sampled at the same steps, and the results of the evaluations during training."""
    steps = np.linspace(0, grid.steps, _POINTS + 1)[1:]
    evaluated = (_EVALUATION, "eval/position_error_mm", "eval/angle_deg")
    with file.open("w", newline="") as stream:
        table = csv.writer(stream)
        table.writerow(["env", "algo", "seed", "steps", _TRAINING, *evaluated])
        for name, run in grid.runs().items():
            rows = curves.get(name, [])
            for step, reward in zip(
                steps, _episode_reward(rows, steps) if rows else (), strict=False
            ):
                cells = [f"{int(step)}", f"{reward / MAX_EPISODE_STEPS:.4f}"]
                table.writerow([run.env, run.algo, run.seed, *cells, "", "", ""])
            for row in rows:
                if _EVALUATION in row:
                    cells = [f"{row[column]:.5g}" for column in evaluated]
                    table.writerow(
                        [run.env, run.algo, run.seed, row["time/total_timesteps"], "", *cells]
                    )
    return file


def _rows(grid: Grid, results: dict[str, dict[str, Any]]) -> Iterator[dict[str, Any]]:
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
                if "angle" in title and not getattr(named_task(env), "orientation", False):
                    values = [math.inf]  # the task does not judge the angle
                row[title] = interquartile_mean(values), digits
            yield row


def _value(result: dict[str, Any], path: tuple[str, ...]) -> float:
    value: Any = result
    for key in path:
        value = value[key]
    return float("inf") if value is None else float(value)


def _write_table(file: Path, rows: list[dict[str, Any]]) -> Path:
    with file.open("w", newline="") as stream:
        table = csv.writer(stream)
        titles = [f"{title}, {part}" for title in COLUMNS for part in ("iqm", "low", "high")]
        table.writerow(["environment", "algorithm", "seeds", *titles])
        for row in rows:
            cells = [f"{v:.6g}" for title in COLUMNS for v in asdict(row[title][0]).values()]
            table.writerow([row["environment"], row["algorithm"], row["seeds"], *cells])
    return file


def _markdown(rows: list[dict[str, Any]]) -> str:
    titles = ["environment", "algorithm", "seeds", *COLUMNS]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for row in rows:
        cells = [row["environment"], row["algorithm"].upper(), str(row["seeds"])]
        cells += [format_interval(*row[title]) for title in COLUMNS]
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
