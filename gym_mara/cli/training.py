"""gym-mara train: trains an agent into a run folder, or resumes a run."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gym_mara.agents.algorithms.registry import ALGORITHMS, DEFAULT_ALGORITHM, DEFAULT_PRESET
from gym_mara.agents.training import DEFAULT_LOGGERS, LOGGERS
from gym_mara.cli.agents import print_metrics
from gym_mara.cli.common import (
    AlgoOption,
    CheckpointOption,
    EnvOption,
    OwnBackendOption,
    PresetOption,
    SetOption,
    StepsOption,
    interruptible,
    is_given,
    keyword_arguments,
    names_in,
    needs_agents,
    one_of,
    out,
    refuse,
    several,
    whole,
)
from gym_mara.cli.policies import PolicyOption
from gym_mara.errors import GymMaraError
from gym_mara.registration import environment, file_name, own_backend
from gym_mara.tasks import named_task

if TYPE_CHECKING:
    from gym_mara.agents.runs.folder import RunConfig


def train(
    context: typer.Context,
    env: EnvOption = "MARA-v0",
    algo: AlgoOption = DEFAULT_ALGORITHM,
    backend: OwnBackendOption = None,
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
    start: Annotated[
        Path | None,
        typer.Option(
            "--from",
            help="Start with the policy of this run. Its environment with all settings, backend, algorithm and preset are the defaults.",
        ),
    ] = None,
    from_policy: PolicyOption = "last",
    log: Annotated[
        list[str],
        typer.Option(
            parser=several(one_of("logger", lambda: LOGGERS)),
            envvar="MARA_LOG_FORMAT",
            metavar="NAMES",
            help=f"Loggers, separated by commas: {', '.join(LOGGERS)}. The table progress.csv is always written.",
        ),
    ] = [*DEFAULT_LOGGERS],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Train an agent into a run folder: policy, checkpoints, learning curve, TensorBoard log. Needs the extra train."""
    with needs_agents():
        from gym_mara.agents.runs.evaluation import episodes_to_judge, evaluate_run
        from gym_mara.agents.runs.folder import RunConfig, RunFolder
        from gym_mara.agents.training.train import resume as resume_training
        from gym_mara.agents.training.train import train as start_training
        from gym_mara.agents.training.warm_start import started_from

    loggers = names_in("--log", log)
    if resume is not None:
        params = context.command.params
        others = (p.name or "" for p in params if p.name not in ("resume", "log"))
        refuse(context, "--resume uses the options of the run", *others)
        interrupted = RunFolder.open(resume)
        if not interrupted.checkpoints() and interrupted.config.start is None:
            out.print("The run has no checkpoint: it starts from the beginning.", soft_wrap=True)
        with _progress(interrupted.config.steps, resume) as on_progress:
            run = resume_training(resume, on_progress, log=loggers)
    else:
        options = keyword_arguments(settings)
        chosen = {"env": env, "algo": algo, "backend": backend, "preset_name": preset}
        numbers = {"steps": steps, "seed": seed, "checkpoint_every": checkpoint_every}
        if start is None:
            refuse(context, "without --from it has no effect", "from_policy")
            chosen["backend"] = backend or own_backend(env)
            config = RunConfig(**chosen, **numbers, env_options=options)  # type: ignore[arg-type]
        else:
            given = {k: v for k, v in chosen.items() if is_given(context, k.removesuffix("_name"))}
            source = RunFolder.open(start)
            config = started_from(source, from_policy, options, **given, **numbers)
        for name in options:
            _refuse_hyperparameter(name, config.env)
        if "gamma" in options:
            out.print(
                "note: gamma is a constant of the reward here; the discount factor is a part of the preset.",
                soft_wrap=True,
            )
        folder = out_folder or _default_folder(config)
        with _progress(config.steps, folder) as on_progress:
            run = start_training(config, folder, on_progress, log=loggers)
    metrics = evaluate_run(run, episodes=episodes_to_judge(run.config))
    print_metrics(f"{run.config.env} on {run.config.backend}, last policy", metrics)
    if (trained := run.trained_steps()) > run.config.steps:
        out.print(f"Trained {trained:,} steps: an update needs a whole rollout of all arms.")
    out.print(f"Run folder: {run.path}", soft_wrap=True)


def _refuse_hyperparameter(name: str, env: str) -> None:
    """Raises GymMaraError if this name is a hyperparameter of the algorithms' presets, and none of the environment's task."""
    own = vars(named_task(environment(env).task)).keys()
    presets = [p for entry in ALGORITHMS.values() for v in entry.presets.values() for p in v[:2]]
    if name in {key for preset in presets for key in preset.arguments} - own:
        raise GymMaraError(
            f"--set {name}: it is a hyperparameter of the algorithm, and --set takes keyword arguments of the environment. "
            "Hyperparameters are presets: give --preset, or train with gym_mara.agents.training.train.preset_agent"
        )


def _default_folder(config: RunConfig) -> Path:
    """A folder in runs/ named after the run and the time."""
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    env = file_name(config.env)
    return Path("runs") / f"{config.algo}_{env}_{config.backend}_seed{config.seed}_{stamp}"


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
    if run.config.start is not None and not checkpoints:
        return "Interrupted. Nothing was saved."
    kept = (
        f"The checkpoint at step {int(checkpoints[-1].name):,} is kept; resume"
        if checkpoints
        else "There is no checkpoint yet; start again from the beginning"
    )
    return f"Interrupted. {kept} with gym-mara train --resume {shlex.quote(str(path))}"
