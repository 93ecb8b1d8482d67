"""gym-mara train, evaluate and transfer: the commands for one run."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import typer
from rich import box
from rich.table import Column, Table

from gym_mara.agents.algorithms.registry import DEFAULT_ALGORITHM, DEFAULT_PRESET
from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.cli.common import (
    AlgoOption,
    BackendOption,
    CheckpointOption,
    EnvOption,
    PolicyOption,
    PresetOption,
    RunBackendOption,
    SetOption,
    StepsOption,
    backend_name,
    interruptible,
    keyword_arguments,
    names_in,
    needs_agents,
    one_of,
    out,
    refuse,
    several,
    whole,
)
from gym_mara.errors import GymMaraError
from gym_mara.registration import file_name
from gym_mara.types import Floats

RunArgument = Annotated[Path, typer.Argument(help="A run folder.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON and nothing else.")]
EpisodesOption = Annotated[
    int,
    typer.Option(
        parser=whole(1, 100_000), metavar="N", help="How many episodes to play, on each backend."
    ),
]
SeedOption = Annotated[
    int,
    typer.Option(
        parser=whole(0, 2**32 - 1),
        metavar="N",
        help="Seed of the episodes. None has episodes in common with a training or with the choice of its best policy.",
    ),
]


def _baselines() -> Iterable[str]:
    """The names of the baselines."""
    with needs_agents():
        from gym_mara.agents.evaluation.baselines import BASELINES
    return BASELINES


def train(
    context: typer.Context,
    env: EnvOption = "MARA-v0",
    algo: AlgoOption = DEFAULT_ALGORITHM,
    backend: BackendOption = DEFAULT_BACKEND,
    steps: StepsOption = 1_000_000,
    seed: Annotated[
        int,
        typer.Option(
            parser=whole(0, 2**32 - 1),
            metavar="N",
            help="Seed of the policy, the sampling and the environment.",
        ),
    ] = 0,
    out_folder: Annotated[
        Path | None,
        typer.Option(
            "--out",
            help="New run folder; by default a folder in runs/ named after the run and the time.",
        ),
    ] = None,
    preset: PresetOption = DEFAULT_PRESET,
    checkpoint_every: CheckpointOption = 50_000,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
    resume: Annotated[
        Path | None,
        typer.Option(help="Resume this run from its last checkpoint, with its own options."),
    ] = None,
) -> None:
    """Train an agent into a run folder: policy, checkpoints, learning curve, TensorBoard log. Needs the extra train."""
    with needs_agents():
        from gym_mara.agents.runs.evaluation import episodes_to_judge, evaluate_run
        from gym_mara.agents.runs.folder import RunConfig, RunFolder
        from gym_mara.agents.training.train import resume as resume_training
        from gym_mara.agents.training.train import train as start_training

    if resume is not None:
        others = (p.name or "" for p in context.command.params if p.name != "resume")
        refuse(context, "--resume uses the options of the run", *others)
        interrupted = RunFolder.open(resume)
        if not interrupted.checkpoints():
            out.print("The run has no checkpoint: it starts from the beginning.", soft_wrap=True)
        with _progress(interrupted.config.steps, resume) as on_progress:
            run = resume_training(resume, on_progress)
    else:
        config = RunConfig(
            env=env,
            algo=algo,
            backend=backend,
            steps=steps,
            seed=seed,
            checkpoint_every=checkpoint_every,
            preset_name=preset,
            env_options=keyword_arguments(settings),
        )
        stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
        folder = (
            out_folder or Path("runs") / f"{algo}_{file_name(env)}_{backend}_seed{seed}_{stamp}"
        )
        with _progress(config.steps, folder) as on_progress:
            run = start_training(config, folder, on_progress)
    metrics = evaluate_run(run, episodes=episodes_to_judge(run.config))
    _print_metrics(f"{run.config.env} on {run.config.backend}, last policy", metrics)
    if (trained := run.trained_steps()) > run.config.steps:
        out.print(f"Trained {trained:,} steps: an update needs a whole rollout of all arms.")
    out.print(f"Run folder: {run.path}", soft_wrap=True)


def evaluate(
    context: typer.Context,
    run: Annotated[
        Path | None, typer.Argument(help="A run folder; leave it out with --baseline.")
    ] = None,
    baseline: Annotated[
        str | None,
        typer.Option(
            parser=one_of("baseline", _baselines),
            metavar="NAME",
            help="Instead of a run: ik, inverse kinematics and a straight joint move at the joints' velocity limits.",
        ),
    ] = None,
    env: EnvOption = "MARA-v0",
    backend: RunBackendOption = None,
    episodes: EpisodesOption = 10,
    seed: SeedOption = 0,
    policy: PolicyOption = "last",
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
    as_json: JsonOption = False,
) -> None:
    """Measure a run's deterministic policy, or a baseline: accuracy, success, collisions, settling, tremble, reward.

    Needs the extra train.
    """
    with needs_agents():
        from gym_mara.agents.evaluation.baselines import evaluate_baseline
        from gym_mara.agents.evaluation.metrics import spread
        from gym_mara.agents.runs.evaluation import evaluate_run
        from gym_mara.agents.runs.folder import RunFolder

    options = keyword_arguments(settings)
    if baseline is not None:
        refuse(context, "--baseline plays no run", "run", "policy")
        backend, who = backend or DEFAULT_BACKEND, f"baseline {baseline}"
        metrics = evaluate_baseline(
            baseline, env, backend=backend, episodes=episodes, seed=seed, options=options
        )
    elif run is not None:
        refuse(context, "the run has its own environment", "env")
        folder = RunFolder.open(run)
        env, who = folder.config.env, f"{policy} policy"
        backend = backend or folder.config.backend
        metrics = evaluate_run(
            folder, backend=backend, episodes=episodes, seed=seed, which=policy, options=options
        )
    else:
        raise GymMaraError("give a run folder, or --baseline ik and --env")
    if as_json:
        print(json.dumps(spread(metrics), indent=2))
    else:
        _print_metrics(f"{env} on {backend}, {who}, seed {seed}", metrics)


def transfer(
    run: RunArgument,
    backend: Annotated[
        list[str],
        typer.Option(
            parser=several(backend_name),
            metavar="NAMES",
            help="Backends to play on, separated by commas; by default all that work on this machine.",
        ),
    ] = [],  # noqa: B006 - Typer reads it and never changes it
    episodes: EpisodesOption = 1,
    seed: SeedOption = 0,
    policy: PolicyOption = "last",
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
    as_json: JsonOption = False,
) -> None:
    """Play a run's policy on several backends, and compare the results. Needs the extra train."""
    with needs_agents():
        from gym_mara.agents.evaluation.metrics import METRICS, mean_in_short, spread
        from gym_mara.agents.inspection.transfer import transfer as play_on_all
        from gym_mara.agents.runs.folder import RunFolder

    options, names = keyword_arguments(settings), names_in("--backend", backend)
    folder = RunFolder.open(run)
    rows = play_on_all(
        folder, backends=names, episodes=episodes, seed=seed, which=policy, options=options
    )
    if as_json:
        found = [{"backend": r.backend, "settings": r.settings, **spread(r.metrics)} for r in rows]
        print(json.dumps(found, indent=2))
        return
    titles = [
        ",\n".join([row.backend, *(f"{name}\n= {value}" for name, value in row.settings.items())])
        for row in rows
    ]
    columns = (Column(title, justify="right", overflow="fold") for title in titles)
    table = Table("", *columns, title=", ".join([folder.config.env, f"{policy} policy", *settings]))
    for name, title in METRICS.items():
        table.add_row(title, *(mean_in_short(name, row.metrics[name]) for row in rows))
    out.print(table)


@contextmanager
def _progress(total: int, run: Path) -> Iterator[Any]:
    """A progress bar, updated by the function that this yields; after an interrupt it says what is kept."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.completed:>9,.0f} / {task.total:,.0f} steps"),
        BarColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
    )
    bar = Progress(*columns, console=out)
    task = bar.add_task("", total=total)

    with interruptible(lambda: _kept(run)):

        def on_progress(steps: int, shown: dict[str, float]) -> None:
            bar.start()  # not before the training has started: an error before shows no bar
            text = f"reward {shown['reward_per_step']:6.2f}" if "reward_per_step" in shown else ""
            if "eval_position_error_mm" in shown:
                text += f"   evaluated: {shown['eval_position_error_mm']:.1f} mm"
            bar.update(task, completed=min(steps, total), description=text)

        try:
            yield on_progress
        finally:
            if bar.live.is_started:
                bar.stop()


def _kept(path: Path) -> str:
    """What an interrupted training has left in its folder, and how to resume it."""
    from gym_mara.agents.runs.folder import RunFolder

    try:
        run = RunFolder.open(path)
    except GymMaraError:
        return "Interrupted. Nothing was saved."
    checkpoints = run.checkpoints()
    kept = (
        f"The checkpoint at step {int(checkpoints[-1].name):,} is kept; resume"
        if checkpoints
        else "There is no checkpoint yet; start again from the beginning"
    )
    return f"Interrupted. {kept} with gym-mara train --resume {shlex.quote(str(path))}"


def _print_metrics(title: str, metrics: dict[str, Floats]) -> None:
    """The statistics of each metric in a table of at most 80 columns."""
    from gym_mara.agents.evaluation.metrics import METRICS, STATISTICS, statistics_in_short

    columns = (Column(name, justify="right", no_wrap=True) for name in STATISTICS)
    count = len(metrics["return"])
    table = Table(
        "",
        *columns,
        title=f"{title}, {count:,} episode{'s' * (count > 1)}",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for name, label in METRICS.items():
        table.add_row(label, *statistics_in_short(name, metrics[name]))
    out.print(table)
