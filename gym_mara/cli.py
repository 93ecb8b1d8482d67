"""The command `gym-mara`."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Column, Table
from rich.text import Text

from gym_mara import regression
from gym_mara.backends import backend_names
from gym_mara.errors import GymMaraError, MissingExtraError
from gym_mara.robot.catalog import robot_names
from gym_mara.tasks import TASKS

if TYPE_CHECKING:
    from gym_mara.agents.run import RunFolder

app = typer.Typer(
    help="Train, evaluate and guard agents for the robot arm MARA.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
_out = Console()
_UNITS = {
    "position_error_mm": "position error, mm",
    "angle_deg": "angle, deg",
    "reward_per_step": "reward per step",
    "return": "return",
    "collisions": "collisions",
}

EnvOption = Annotated[str, typer.Option("--env", help="Environment: " + ", ".join(TASKS) + ".")]
BackendOption = Annotated[str, typer.Option(help="Backend: see gym-mara list.")]
SetOption = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Keyword argument of the environment, as JSON, such as --set max_joint_velocity=1.57 "
        "or --set robot=ur5. May be repeated.",
    ),
]


@app.command()
def train(
    env: EnvOption = "MARA-v0",
    algo: Annotated[str, typer.Option(help="Algorithm: ppo.")] = "ppo",
    backend: BackendOption = "pinocchio",
    steps: Annotated[
        float, typer.Option(help="Environment steps over all arms, such as 1e6.")
    ] = 1e6,
    seed: Annotated[int, typer.Option(help="Seed of policy, sampling and environment.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="New run folder; by default one under runs/ named after run and time."),
    ] = None,
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
    with _agents():
        from gym_mara.agents.run import RunConfig, RunFolder
        from gym_mara.agents.train import resume as go_on
        from gym_mara.agents.train import train as begin

    if resume is not None:
        with _progress(RunFolder.open(resume).config.steps, resume) as report:
            run = go_on(resume, report)
    else:
        config = RunConfig(
            env=_task(env),
            algo=algo,
            backend=backend,
            steps=_whole("--steps", steps),
            seed=seed,
            checkpoint_every=_whole("--checkpoint-every", checkpoint_every),
            env_options=_options(settings),
        )
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        folder = out or Path("runs") / f"{algo}_{config.env}_{backend}_seed{seed}_{stamp}"
        with _progress(config.steps, folder) as report:
            run = begin(config, folder, report)
    _print_evaluation(run, episodes=1)
    _out.print(f"Run folder: {run.path}", soft_wrap=True)


@app.command()
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
    with _agents():
        from gym_mara.agents.evaluate import evaluate_run, spread
        from gym_mara.agents.run import RunFolder

    folder = RunFolder.open(run)
    if as_json:
        metrics = evaluate_run(folder, backend=backend, episodes=episodes, which=policy)
        print(json.dumps(spread(metrics), indent=2))
    else:
        _print_evaluation(folder, backend=backend, episodes=episodes, which=policy)


@app.command()
def transfer(
    run: Annotated[Path, typer.Argument(help="A run folder.")],
    episodes: Annotated[int, typer.Option(help="How many episodes to play on each backend.")] = 1,
    policy: Annotated[str, typer.Option(help="last or best.")] = "last",
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Play a run's policy on every backend, side by side: what it loses between simulations."""
    with _agents():
        from gym_mara.agents.run import RunFolder
        from gym_mara.agents.transfer import transfer as play

    folder = RunFolder.open(run)
    rows = play(folder, episodes=episodes, which=policy, options=_options(settings))
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
    _out.print(table)


@app.command("list")
def list_() -> None:
    """Show the environments, the backends and the robots."""
    columns = Column("environment", no_wrap=True), "reward uses", "on a collision"
    table = Table(*columns, title="Environments")
    for name, task in TASKS.items():
        uses = ["distance"]
        uses += ["orientation"] if getattr(task, "orientation", False) else []
        uses += ["collision"] if getattr(task, "collision_penalty", False) else []
        table.add_row(f"gym_mara/{name}", ", ".join(uses), task.on_collision)
    _out.print(table)
    _out.print("Backends:", ", ".join(backend_names()))
    _out.print("Robots:", ", ".join(robot_names()), "- or the path of a URDF")


@app.command()
def rewards(
    record: Annotated[Path | None, typer.Option(help="New file to write the rewards to.")] = None,
    check: Annotated[
        Path | None, typer.Option(help="Recorded file to compute anew; exits 1 if a value moved.")
    ] = None,
    env: EnvOption = "MARA-v0",
    backend: Annotated[
        str | None,
        typer.Option(help="Backend; by default pinocchio, or with --check the record's own."),
    ] = None,
    states: Annotated[int, typer.Option(help="How many states to record.")] = 256,
    tolerance: Annotated[float, typer.Option(help="How far a value may move.")] = 1e-9,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Guard a reward function: record its values over a fixed grid of states, or check them."""
    if (record is None) == (check is None):
        raise GymMaraError("say either --record FILE or --check FILE")
    if record is not None:
        made = regression.record(_task(env), backend or "pinocchio", _options(settings), states)
        regression.write(record, made)
        _out.print(f"{states} states of {made.env} on {made.backend} recorded in {record}")
    if check is not None:
        moved = regression.check(check, backend, tolerance)
        for value in moved:
            print(value)
        if moved:
            print(f"{len(moved)} values of {check} moved by more than {tolerance:g}")
            raise typer.Exit(1)
        _out.print(f"{check}: nothing moved by more than {tolerance:g}")


def main() -> None:
    """Run the command; what the user can mend is told in a line, without a traceback."""
    try:
        app()
    except GymMaraError as error:
        # A Text, not a string: an extra's brackets are no markup.
        text = Text.assemble(("error: ", "bold red"), str(error))
        Console(stderr=True).print(text, soft_wrap=True)
        sys.exit(2)


@contextmanager
def _agents() -> Iterator[None]:
    """Names the extra where a library that training needs is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        library = error.name or str(error)
        raise MissingExtraError("training and evaluation", library, "train") from error


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
    bar = Progress(*columns, console=_out)
    task = bar.add_task("", total=total)

    with _interruptible(interrupted):

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


@contextmanager
def _interruptible(message: str) -> Iterator[None]:
    try:
        yield
    except KeyboardInterrupt:
        _out.print(message, soft_wrap=True)
        raise typer.Exit(130) from None


def _print_evaluation(run: RunFolder, **arguments: Any) -> None:
    from gym_mara.agents.evaluate import evaluate_run, spread

    metrics = evaluate_run(run, **arguments)
    config = run.config
    which, backend = arguments.get("which", "last"), arguments.get("backend") or config.backend
    title = f"{config.env} on {backend}, {which} policy, {arguments['episodes']} episode(s)"
    table = Table("", "mean", "std", "min", "max", title=title)
    for name, values in spread(metrics).items():
        table.add_row(_UNITS[name], *(f"{value:.2f}" for value in values.values()))
    _out.print(table)


def _mean_and_spread(values: NDArray[np.float64]) -> str:
    mean, spread = values.mean(), values.std()
    if np.isnan(mean):
        return "-"
    return f"{mean:.2f}" + (f" ± {spread:.2f}" if len(values) > 1 else "")


def _task(env: str) -> str:
    """The name of a task, with or without the namespace of its id."""
    name = env.removeprefix("gym_mara:").removeprefix("gym_mara/")
    if name not in TASKS:
        from gym_mara.errors import unknown

        raise unknown("environment", env, TASKS)
    return name


def _whole(option: str, value: float) -> int:
    if not (value >= 1 and value == value // 1):
        raise GymMaraError(f"{option} must be a whole number of at least 1, not {value:g}")
    return int(value)


def _options(settings: list[str]) -> dict[str, Any]:
    """Keyword arguments from NAME=VALUE; a value that is not JSON is a string."""
    options = {}
    for setting in settings:
        name, separator, value = setting.partition("=")
        if not separator or not name.isidentifier():
            raise GymMaraError(f"--set {setting!r}: write NAME=VALUE")
        try:
            options[name] = json.loads(value)
        except ValueError as error:
            if value.lstrip().startswith(("{", "[", '"')):
                raise GymMaraError(f"--set {setting}: the value is not JSON: {error}") from None
            options[name] = value
    return options


if __name__ == "__main__":
    main()
