"""gym-mara benchmark, plot and search: the commands for many runs."""

from __future__ import annotations

import json
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.table import Table

from gym_mara.agents.algorithms.registry import (
    ALGORITHMS,
    DEFAULT_ALGORITHM,
    DEFAULT_PRESET,
)
from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.backends.processes import cores
from gym_mara.cli.common import (
    AlgoOption,
    CheckpointOption,
    EnvOption,
    OwnBackendOption,
    PresetOption,
    SeedsOption,
    StepsOption,
    algorithm_name,
    env_name,
    interruptible,
    names_in,
    needs_agents,
    one_of,
    out,
    several,
    whole,
)
from gym_mara.errors import GymMaraError, unknown
from gym_mara.files import read_text
from gym_mara.registration import file_name, own_backend
from gym_mara.tasks import PAPER_TASKS

if TYPE_CHECKING:
    from gym_mara.agents.experiments.executor import Executor
    from gym_mara.agents.experiments.grid import Grid

EXECUTORS = ("local", "ray")

JobsOption = Annotated[
    int | None,
    typer.Option(
        parser=whole(1, 1024),
        metavar="N",
        help="How many runs at a time; by default one on each core.",
    ),
]


def benchmark(
    env: Annotated[
        list[str],
        typer.Option(
            parser=several(env_name),
            metavar="NAMES",
            help="Environments, separated by commas.",
        ),
    ] = [*PAPER_TASKS],  # noqa: B006 - Typer reads it and never changes it
    algo: Annotated[
        list[str] | None,
        typer.Option(
            parser=several(algorithm_name),
            metavar="NAMES",
            help="Algorithms, separated by commas; by default the paper's that have the preset.",
        ),
    ] = None,
    seeds: SeedsOption = 3,
    steps: StepsOption = 1_000_000,
    preset: PresetOption = DEFAULT_PRESET,
    backend: OwnBackendOption = None,
    checkpoint_every: CheckpointOption = 50_000,
    jobs: JobsOption = None,
    executor: Annotated[
        str,
        typer.Option(
            parser=one_of("executor", lambda: EXECUTORS),
            metavar="NAME",
            help="Where the runs are trained: local, on this machine, or ray, on a cluster.",
        ),
    ] = "local",
    address: Annotated[
        str | None,
        typer.Option(
            help="Address of the Ray cluster, host:port; by default RAY_ADDRESS, or this machine."
        ),
    ] = None,
    out_folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the grid; an interrupted grid is resumed."),
    ] = None,
) -> None:
    """Train every algorithm on every environment with every seed; an interrupted grid is resumed.

    Needs the extra train, and --executor ray the extra ray.
    """
    with needs_agents():
        from gym_mara.agents.experiments.figures import plot_grid
        from gym_mara.agents.experiments.grid import Grid, open_grid, run_grid
        from gym_mara.agents.runs.config import check_backend

    if backend is None:
        for name in names_in("--env", env):
            check_backend(own_backend(name))
    grid = Grid(
        envs=names_in("--env", env),
        algos=names_in("--algo", algo) if algo else _paper_algorithms(preset),
        seeds=seeds,
        steps=steps,
        preset_name=preset,
        backend=backend or DEFAULT_BACKEND,
        checkpoint_every=checkpoint_every,
    )
    run_jobs = _executor(executor, jobs, address)
    folder = out_folder or Path("runs") / f"benchmark_{preset}"
    open_grid(folder, grid)
    with interruptible(
        "Interrupted. Finished runs and checkpoints are kept: run the same command again to go on from them"
    ):
        view = _GridView(folder, grid)
        with Live(get_renderable=view.table, console=out, refresh_per_second=2) as live:
            view.notice = live.console.print
            failed = run_grid(folder, grid, run_jobs, view.on_message)
    for name, reason in failed.items():
        out.print(f"{name} failed: {reason}", style="red", soft_wrap=True)
    if len(failed) < len(grid.runs()):
        for file in plot_grid(folder):
            out.print(str(file), soft_wrap=True)
    if failed:
        raise GymMaraError(
            f"{len(failed)} of {len(grid.runs())} runs failed; remove the cause and run the same command again"
        )


def _paper_algorithms(preset: str) -> tuple[str, ...]:
    """The algorithms of ROS2Learn that have a preset."""
    return tuple(
        name for name, entry in ALGORITHMS.items() if {"paper", preset} <= {*entry.presets}
    )


def plot(folder: Annotated[Path, typer.Argument(help="The folder of a benchmark.")]) -> None:
    """Draw the figures of a benchmark and write its tables. Needs the extra train."""
    with needs_agents():
        from gym_mara.agents.experiments.figures import plot_grid

    for file in plot_grid(folder):
        out.print(str(file), soft_wrap=True)
    out.print(read_text(folder / "table.md"), soft_wrap=True)


def search(
    env: EnvOption = "MARACollisionOrient-v0",
    algo: AlgoOption = DEFAULT_ALGORITHM,
    steps: StepsOption = 1_000_000,
    trials: Annotated[
        int,
        typer.Option(
            parser=whole(1, 100_000),
            metavar="N",
            help="How many trials in all; a few more if several run at the same time.",
        ),
    ] = 40,
    seeds: SeedsOption = 1,
    jobs: JobsOption = None,
    out_folder: Annotated[
        Path | None,
        typer.Option("--out", help="Folder of the search; an interrupted search is resumed."),
    ] = None,
) -> None:
    """Search an algorithm's hyperparameters with Optuna, on seeds that no reported result uses.

    Needs the extra train.
    """
    with needs_agents():
        from gym_mara.agents.experiments import search as module

    processes = _processes(jobs)
    wanted = module.Search(env, algo, steps, trials, seeds)
    folder = out_folder or Path("runs") / f"search_{algo}_{file_name(env)}"
    study = module.open_study(wanted, folder)

    def show_best() -> None:
        best = module.best_trial(study)
        text = "none finished yet"
        if best is not None and best.value is not None:
            reward = module.reward_of(best.value)
            text = f"best: {reward:.6g} per step, with {json.dumps(best.params)}"
        out.print(f"{module.finished_trials(study)} of {trials} trials, {text}", soft_wrap=True)

    def on_message(name: str, message: Any) -> None:
        if message is not None:
            show_best()

    with interruptible("Interrupted. Finished trials are kept: run the same command again"):
        failed = module.run_search(wanted, folder, processes, on_message)
    if failed:
        raise GymMaraError("; ".join(f"{name}: {reason}" for name, reason in failed.items()))
    show_best()


def _executor(name: str, jobs: int | None, address: str | None) -> Executor:
    """The executor of this name, with the options that it takes."""
    if name == "local":
        if address is not None:
            raise GymMaraError("--address is for --executor ray only")
        from gym_mara.agents.experiments.local_executor import run_in_processes

        return partial(run_in_processes, processes=_processes(jobs))
    if name == "ray":
        if jobs is not None:
            raise GymMaraError("--jobs is for --executor local only; a cluster uses all its cores")
        from gym_mara.agents.experiments.ray_executor import run_on_ray

        return partial(run_on_ray, address=address)
    raise unknown("executor", name, EXECUTORS)


def _processes(jobs: int | None) -> int:
    return len(cores()) if jobs is None else jobs


class _GridView:
    """A table of the runs of a grid: their progress and their position errors."""

    def __init__(self, folder: Path, grid: Grid) -> None:
        from gym_mara.agents.experiments.grid import valid_result

        self._grid = grid
        self._runs = grid.runs()
        self._started = time.monotonic()
        self._steps: dict[str, int] = {}
        self._shown: dict[str, dict[str, float]] = {}
        for name in self._runs:
            result = valid_result(folder / name)
            if result is not None:
                self._steps[name] = grid.steps
                error = result["last"]["position_error_mm"]
                self._shown[name] = {} if error is None else {"eval_position_error_mm": error}
        self._first: dict[str, int] = dict(self._steps)
        self.notice: Any = out.print

    def on_message(self, name: str, message: Any) -> None:
        """Show a notice of a run, or keep its progress for the table."""
        if isinstance(message, str):
            self.notice(f"{name}: {message}", style="yellow", soft_wrap=True)
        elif message is not None:
            steps, shown = message
            self._first.setdefault(name, steps)
            self._steps[name] = min(steps, self._grid.steps)
            self._shown[name] = {**self._shown.get(name, {}), **shown}

    def table(self) -> Table:
        """The table now: a cell for each pair of environment and algorithm."""
        total = self._grid.steps * len(self._runs)
        done = sum(list(self._steps.values()))
        fresh = done - sum(min(first, self._grid.steps) for first in list(self._first.values()))
        seconds = time.monotonic() - self._started
        left = (total - done) * seconds / fresh if fresh else None
        title = f"{done / total:.0%} of {len(self._runs)} runs, {_clock(seconds)} so far"
        table = Table("", *(a.upper() for a in self._grid.algos), title=title, min_width=48)
        table.caption = f"{_clock(left)} left" if left else None
        for env in self._grid.envs:
            cells = (self._cell(env, algo) for algo in self._grid.algos)
            table.add_row(env, *cells)
        return table

    def _cell(self, env: str, algo: str) -> str:
        parts = []
        for name, run in self._runs.items():
            if (run.env, run.algo) != (env, algo):
                continue
            part = f"{self._steps.get(name, 0) / self._grid.steps:4.0%}"
            error = self._shown.get(name, {}).get("eval_position_error_mm")
            parts.append(part + (f" {error:7.2f} mm" if error is not None else ""))
        return "\n".join(parts)


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return (
        f"{minutes} min {rest:02d} s"
        if minutes < 60
        else f"{minutes // 60} h {minutes % 60:02d} min"
    )
