"""gym-mara train, evaluate and transfer: one run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.table import Column, Table

from gym_mara.agents.algorithms.registry import DEFAULT_ALGORITHM, DEFAULT_PRESET
from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.cli.common import (
    AlgoOption,
    BackendOption,
    EnvOption,
    PresetOption,
    SetOption,
    interruptible,
    keyword_arguments,
    needs_agents,
    out,
    task_name,
    whole,
)
from gym_mara.errors import GymMaraError

if TYPE_CHECKING:
    from gym_mara.agents.runs.folder import RunFolder

_UNITS = {
    "position_error_mm": "position error, mm",
    "angle_deg": "angle, deg",
    "reward_per_step": "reward per step",
    "return": "return",
    "collisions": "collisions",
}


def train(
    context: typer.Context,
    env: EnvOption = "MARA-v0",
    algo: AlgoOption = DEFAULT_ALGORITHM,
    backend: BackendOption = DEFAULT_BACKEND,
    steps: Annotated[
        float, typer.Option(help="Environment steps over all arms, such as 1e6.")
    ] = 1e6,
    seed: Annotated[int, typer.Option(help="Seed of policy, sampling and environment.")] = 0,
    out_folder: Annotated[
        Path | None,
        typer.Option(
            "--out", help="New run folder; by default one under runs/ named after run and time."
        ),
    ] = None,
    preset: PresetOption = DEFAULT_PRESET,
    checkpoint_every: Annotated[
        float, typer.Option(help="Steps between two checkpoints, each of which is evaluated.")
    ] = 5e4,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
    resume: Annotated[
        Path | None,
        typer.Option(help="Go on with this run from its last checkpoint; all else is as it was."),
    ] = None,
) -> None:
    """Train an agent and leave a run folder: policy, checkpoints, learning curve, TensorBoard log."""
    with needs_agents():
        from gym_mara.agents.runs.folder import RunConfig, RunFolder
        from gym_mara.agents.training.train import resume as go_on
        from gym_mara.agents.training.train import train as begin

    if resume is not None:
        _refuse_beside_resume(context)
        out.print(
            "Going on unpickles the run's checkpoint, and a pickle can run any code: "
            "do so only with runs that you trust.",
            style="yellow",
            soft_wrap=True,
        )
        with _progress(RunFolder.open(resume).config.steps, resume) as report:
            run = go_on(resume, report)
    else:
        config = RunConfig(
            env=task_name(env),
            algo=algo,
            backend=backend,
            steps=whole("--steps", steps),
            seed=seed,
            checkpoint_every=whole("--checkpoint-every", checkpoint_every),
            preset_name=preset,
            env_options=keyword_arguments(settings),
        )
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        folder = out_folder or Path("runs") / f"{algo}_{config.env}_{backend}_seed{seed}_{stamp}"
        with _progress(config.steps, folder) as report:
            run = begin(config, folder, report)
    _print_evaluation(run, episodes=1)
    out.print(f"Run folder: {run.path}", soft_wrap=True)


def _refuse_beside_resume(context: typer.Context) -> None:
    """A run goes on as it was begun: raises GymMaraError where other options were given."""
    given = []
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name != "resume" and source is not None and source.name == "COMMANDLINE":
            given.append(parameter.opts[0])
    if given:
        raise GymMaraError(
            f"--resume goes on with a run as it was begun: leave out {', '.join(given)}"
        )


def evaluate(
    run: Annotated[Path, typer.Argument(help="A run folder.")],
    backend: Annotated[
        str | None, typer.Option(help="Backend to play on; by default the run's own.")
    ] = None,
    episodes: Annotated[int, typer.Option(help="How many episodes to play.")] = 10,
    policy: Annotated[
        str, typer.Option(help="last, or best: the one that did best when evaluated in training.")
    ] = "last",
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")] = False,
) -> None:
    """Play a run's deterministic policy: position error and angle at the last step, reward, collisions."""
    with needs_agents():
        from gym_mara.agents.runs.evaluation import evaluate_run, spread
        from gym_mara.agents.runs.folder import RunFolder

    folder = RunFolder.open(run)
    if as_json:
        metrics = evaluate_run(folder, backend=backend, episodes=episodes, which=policy)
        print(json.dumps(spread(metrics), indent=2))
    else:
        _print_evaluation(folder, backend=backend, episodes=episodes, which=policy)


def transfer(
    run: Annotated[Path, typer.Argument(help="A run folder.")],
    episodes: Annotated[int, typer.Option(help="How many episodes to play on each backend.")] = 1,
    policy: Annotated[str, typer.Option(help="last or best.")] = "last",
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Play a run's policy on every backend, side by side: what it loses between simulations."""
    with needs_agents():
        from gym_mara.agents.inspection.transfer import transfer as play
        from gym_mara.agents.runs.folder import RunFolder

    folder = RunFolder.open(run)
    rows = play(folder, episodes=episodes, which=policy, options=keyword_arguments(settings))
    names = (
        "position error, mm",
        "angle, deg",
        "return",
        "collisions",
        "settled after, s",
        "highest torque / limit",
        "highest speed, rad/s",
    )
    titles = [Column(row.backend.replace(", ", ",\n"), justify="right") for row in rows]
    table = Table("", *titles, title=f"{folder.config.env}, {policy} policy")
    for index, name in enumerate(names, start=1):
        table.add_row(name, *(_mean_and_spread(np.asarray(row[index])) for row in rows))
    out.print(table)


@contextmanager
def _progress(total: int, run: Path) -> Iterator[Any]:
    """A bar of progress, as the function that a training reports to; an interrupt says how to go on."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.completed:>9,.0f} / {task.total:,.0f} steps"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    interrupted = (
        f"Interrupted. What was trained up to the last checkpoint is kept; go on with\n"
        f"gym-mara train --resume {run}"
    )
    bar = Progress(*columns, console=out)
    task = bar.add_task("", total=total)

    with interruptible(interrupted):

        def report(steps: int, shown: dict[str, float]) -> None:
            bar.start()  # once the training begins: what is refused before shows no bar
            text = f"reward {shown['reward_per_step']:6.2f}" if "reward_per_step" in shown else ""
            if "eval_position_error_mm" in shown:
                text += f"   evaluated: {shown['eval_position_error_mm']:.1f} mm"
            bar.update(task, completed=min(steps, total), description=text)

        try:
            yield report
        finally:
            bar.stop()


def _print_evaluation(run: RunFolder, **arguments: Any) -> None:
    from gym_mara.agents.runs.evaluation import evaluate_run, spread

    metrics = evaluate_run(run, **arguments)
    config = run.config
    which, backend = arguments.get("which", "last"), arguments.get("backend") or config.backend
    title = f"{config.env} on {backend}, {which} policy, {arguments['episodes']} episode(s)"
    table = Table("", "mean", "std", "min", "max", title=title)
    for name, values in spread(metrics).items():
        table.add_row(_UNITS[name], *(f"{value:.2f}" for value in values.values()))
    out.print(table)


def _mean_and_spread(values: NDArray[np.float64]) -> str:
    mean, spread = values.mean(), values.std()
    if np.isnan(mean):
        return "-"
    return f"{mean:.2f}" + (f" ± {spread:.2f}" if len(values) > 1 else "")
