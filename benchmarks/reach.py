"""The pictures and tables of docs/reach.md, from runs of MARAReach-v0 and MARAPose-v0; prints Markdown.

python benchmarks/reach.py runs/reach_* runs/pose_* --backend pinocchio mujoco --out docs/reach_results

Runs of one environment differ in their seed alone. For each environment there are learning curves; for each backend a table of
every seed, their median, and inverse kinematics in the same episodes; and on the first backend a heat map over the workspace,
and a film of ten targets in a row. Files of the same names are replaced.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from reach_figures import CELL, FEWEST, PARTS, Places, draw_curves, draw_workspace

from gym_mara.agents.evaluation.baselines import evaluate_baseline
from gym_mara.agents.evaluation.episodes import episode_seeds
from gym_mara.agents.evaluation.metrics import in_short, spread
from gym_mara.agents.inspection.watch import film_targets, show_run
from gym_mara.agents.runs.evaluation import evaluate_run, make_arms, options_on
from gym_mara.agents.runs.folder import POLICIES, RunFolder, versions
from gym_mara.backends import backend_names, backend_settings
from gym_mara.cli.common import keyword_arguments
from gym_mara.errors import GymMaraError, short, whole_number
from gym_mara.files import writing
from gym_mara.registration import environment, file_name
from gym_mara.tasks import AnyTargetTask, named_task
from gym_mara.types import Floats

ROWS = {
    "position_error_mm": "position error, mm",
    "position_error_mm_without_collision": "position error without a collision, mm",
    "angle_deg": "angle, deg",
    "angle_deg_without_collision": "angle without a collision, deg",
    "success_percent": "success",
    "collision_percent": "episodes with a collision",
    "settled_percent": "settled",
    "settling_time_s": "settling time, s",
    "settling_ratio": "settling time relative to the least",
    "tremble_mm": "tremble, mm",
    "tremble_velocity": "tremble, rad/s",
}
"""The metrics of a table, and their titles."""
SHOWN = ("mean", "p50", "p95")
"""The statistics of a metric that is no share."""
MAY_DIFFER = ("seed", "start", "checkpoint_every")
"""What may differ between the runs of an environment."""
FILM: dict[str, Any] = {"width": 320, "height": 280}
RATE, TARGETS = 10.0, 10
"""Pictures per second of a film, and its targets: it is smaller than 2 MB."""

LEGEND = f"""
Three numbers in a cell of a table are the mean, the median and the 95th percentile over the episodes. In the learning curves a dot is
an evaluation of the training, and a line is the mean of success and the median of an error over a part in {PARTS} of the training. In
the heat maps a cell of {CELL:g} m has the targets of all seeds; grey cells have fewer than {FEWEST}."""

Metrics = dict[str, Floats]
"""Metrics by name, each per episode (N,)."""


class Played(NamedTuple):
    """The same episodes of an environment on one backend."""

    runs: list[Metrics]
    """Of the policy of each run."""
    baseline: Metrics
    """Of inverse kinematics."""


def grouped(runs: Sequence[RunFolder], which: str) -> dict[str, list[RunFolder]]:
    """The runs of each environment, in the order of their seeds.

    Raises:
        GymMaraError: a run has no such policy, or its task is another one; or two runs of an environment have the same seed, or
            differ in more than the seed.
    """
    groups: dict[str, list[RunFolder]] = {}
    for run in sorted(runs, key=lambda run: run.config.seed):
        env = run.config.env
        if not isinstance(named_task(environment(env).task), AnyTargetTask):
            raise GymMaraError(
                f"{str(run.path)!r} is a run of {env}: give runs of MARAReach-v0 and MARAPose-v0"
            )
        run.policy(which)
        groups.setdefault(env, []).append(run)
    for group in groups.values():
        for one, other in itertools.pairwise(group):
            check_alike(one, other)
    return groups


def check_alike(one: RunFolder, other: RunFolder) -> None:
    """Check that two runs of an environment differ in their seed alone.

    Raises:
        GymMaraError: they do not.
    """
    both = f"{str(one.path)!r} and {str(other.path)!r}"
    if one.config.seed == other.config.seed:
        raise GymMaraError(f"{both} have the same seed, {one.config.seed}: give each seed once")
    for field in dataclasses.fields(one.config):
        first, second = (getattr(run.config, field.name) for run in (one, other))
        if field.name not in MAY_DIFFER and first != second:
            raise GymMaraError(
                f"{both} differ in {field.name}, {short(first)} and {short(second)}: give runs that differ in their seed alone"
            )


def report(env: str, runs: list[RunFolder], asked: argparse.Namespace) -> Iterator[str]:
    """The Markdown about the runs of an environment, each part as soon as it is known; writes the pictures."""
    config, seeds = runs[0].config, [run.config.seed for run in runs]
    options = ", ".join(f"`{name}={value}`" for name, value in config.env_options.items())
    yield (
        f"\n## {env}\n\n{config.algo.upper()}, preset `{config.preset_name}`, {config.steps:,} steps on `{config.backend}`"
        f"{' with ' + options if options else ''}; seeds {', '.join(map(str, seeds))}; the {asked.policy} policies.\n"
    )
    first, *others = asked.backend or [config.backend]
    task, places = targets(runs[0], first, asked)
    played = {}
    for backend in (first, *others):
        played[backend] = play(runs, backend, asked)
        corner = f"{asked.episodes:,} episodes, seed {asked.seed}, `{backend}`"
        yield "\n".join(table(corner, seeds, played[backend], task)) + "\n"
    name, results = file_name(env), played[first].runs
    title = f"{env}, {config.algo.upper()}"
    baseline = played[config.backend].baseline if config.backend in played else None
    draw_curves(asked.out / f"{name}_curves.png", title, runs, task, baseline)
    draw_workspace(asked.out / f"{name}_workspace.png", f"{title}, {first}", places, results, task)
    middle = runs[in_the_middle(results)]
    film(middle, asked.out / f"{name}.gif", first, asked)
    for text, ending in (
        ("The evaluations of the training", "_curves.png"),
        (f"The errors over the workspace, of all seeds on {first}", "_workspace.png"),
        (f"Ten targets in a row, seed {middle.config.seed} on {first}", ".gif"),
    ):
        yield f"![{text}]({asked.out.name}/{name}{ending})\n"


def options_for(backend: str, asked: argparse.Namespace) -> dict[str, Any]:
    """The keyword arguments that were given, but for those settings that only other backends have."""
    own = backend_settings(backend)
    others = {name for each in asked.backend for name in backend_settings(each)}.difference(own)
    return {name: value for name, value in asked.options.items() if name not in others}


def targets(
    run: RunFolder, backend: str, asked: argparse.Namespace
) -> tuple[AnyTargetTask, Places]:
    """The task, and where the targets of the episodes are."""
    options = options_on(backend, run.config, options_for(backend, asked))
    arms = make_arms(run.config.env, backend, asked.episodes, options)
    try:
        arms.reset(seed=episode_seeds(asked.seed, 0, asked.episodes))
        simulation = arms.simulation
        robot, target, task = simulation.robot, simulation.goal.position, simulation.task
        axis = robot.kinematics().joint_frames(robot.home[None]).origins[0, 0]
        assert isinstance(task, AnyTargetTask)
        return task, Places(np.hypot(*(target - axis).T[:2]), target[:, 2].copy())
    finally:
        arms.close()


def play(runs: Sequence[RunFolder], backend: str, asked: argparse.Namespace) -> Played:
    """Play the episodes with each policy and with inverse kinematics."""
    options, results = options_for(backend, asked), []
    episodes: dict[str, Any] = {"backend": backend, "episodes": asked.episodes, "seed": asked.seed}
    for run in runs:
        start = time.perf_counter()
        results.append(evaluate_run(run, which=asked.policy, options=options, **episodes))
        tell(f"{run.path} on {backend}", start)
    start, config = time.perf_counter(), runs[0].config
    whole = options_on(backend, config, options)
    baseline = evaluate_baseline("ik", config.env, options=whole, **episodes)
    tell(f"inverse kinematics on {backend}", start)
    return Played(results, baseline)


def tell(what: str, start: float) -> None:
    """Print to standard error how long something took, since `start` of `time.perf_counter`."""
    print(f"{what}: {time.perf_counter() - start:.1f} s", file=sys.stderr, flush=True)


def table(corner: str, seeds: Sequence[int], played: Played, task: AnyTargetTask) -> Iterator[str]:
    """The rows of a Markdown table: a column for each seed, their median if there are several, and inverse kinematics."""
    several = len(seeds) > 1
    heads = [
        corner,
        *(f"seed {seed}" for seed in seeds),
        *(["median"] * several),
        "inverse kinematics",
    ]
    yield row(heads)
    yield "|---" * len(heads) + "|"
    *columns, baseline = (spread(metrics) for metrics in (*played.runs, played.baseline))
    for name, title in ROWS.items():
        if name.startswith("angle") and not task.orientation:
            continue
        shown = SHOWN[:1] if name.endswith("_percent") else SHOWN
        values = np.array([[(of[name] or {}).get(key, np.nan) for key in shown] for of in columns])
        there = values[~np.isnan(values[:, 0])]
        cells = [*values, *([np.median(there, axis=0) if len(there) else values[0]] * several)]
        cells.append(np.array([(baseline[name] or {}).get(key, np.nan) for key in shown]))
        yield row([title, *(cell(each) for each in cells)])


def row(cells: Sequence[str]) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def cell(values: Floats) -> str:
    """A share, or the SHOWN statistics; "-" if no episode has a value."""
    if np.isnan(values[0]):
        return "-"
    return f"{values[0]:.1f} %" if len(values) == 1 else ", ".join(map(in_short, values))


def in_the_middle(results: Sequence[Metrics]) -> int:
    """Which of the runs is in the middle by its success, and then by its median position error; of an even number the worse."""

    def rank(index: int) -> tuple[float, float]:
        found = results[index]
        return -found["success_percent"].mean(), float(np.median(found["position_error_mm"]))

    return sorted(range(len(results)), key=rank)[len(results) // 2]


def film(run: RunFolder, file: Path, backend: str, asked: argparse.Namespace) -> None:
    """Film ten targets in a row; the file is replaced."""
    start, options = time.perf_counter(), {**FILM, **options_for(backend, asked)}
    with writing(file), tempfile.TemporaryDirectory(dir=file.parent) as folder:
        new = Path(folder) / file.name
        film_targets(show_run(run, asked.policy), new, backend, options, targets=TARGETS, rate=RATE)
        os.replace(new, file)
    tell(f"{file}, {file.stat().st_size / 1e6:.1f} MB", start)


def arguments() -> argparse.Namespace:
    """What the command line asks for.

    Raises:
        GymMaraError: an option is not valid, or the folder cannot be made.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN", help="run folders")
    parser.add_argument("--out", type=Path, required=True, help="the folder of the pictures")
    parser.add_argument(
        "--backend",
        nargs="+",
        choices=backend_names(),
        default=[],
        help="by default that of the runs",
    )
    parser.add_argument("--episodes", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0, help="of the episodes")
    parser.add_argument("--policy", choices=POLICIES, default=POLICIES[0])
    parser.add_argument(
        "--set",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="keyword arguments of the environment, beside those of the runs; a setting of a backend goes to the backends that have it",
    )
    asked = parser.parse_args()
    asked.episodes = whole_number("--episodes", asked.episodes)
    asked.options = keyword_arguments(asked.set)
    with writing(asked.out):
        asked.out.mkdir(parents=True, exist_ok=True)
    return asked


def main() -> None:
    """Write the pictures, and print the Markdown."""
    try:
        asked = arguments()
        groups = grouped([RunFolder.open(path) for path in asked.runs], asked.policy)
        found = ", ".join(f"{name} {version}" for name, version in versions().items())
        print(f"Measured on {date.today()} with {found}; {os.cpu_count()} cores.")
        print(LEGEND)
        for env, runs in groups.items():
            for part in report(env, runs, asked):
                print(part, flush=True)
    except GymMaraError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
