"""gym-mara evaluate, transfer and export: the commands for the policy of a run."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated

import typer
from rich import box
from rich.table import Column, Table

from gym_mara.cli.common import (
    EnvOption,
    RunBackendOption,
    SetOption,
    backend_name,
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
from gym_mara.cli.policies import AnyPolicyOption, PolicyOption, exported_file
from gym_mara.deploy import OnnxPolicy
from gym_mara.errors import GymMaraError
from gym_mara.registration import own_backend
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


def evaluate(
    context: typer.Context,
    run: Annotated[
        Path | None,
        typer.Argument(help="A run folder; leave it out with --baseline or an exported policy."),
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
    policy: AnyPolicyOption = "last",
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
    as_json: JsonOption = False,
) -> None:
    """Measure a deterministic policy, or a baseline: accuracy, success, collisions, settling, tremble, reward.

    Needs the extra train, and for an exported policy the extra deploy.
    """
    with needs_agents():
        from gym_mara.agents.evaluation.baselines import evaluate_baseline
        from gym_mara.agents.evaluation.exported import evaluate_exported
        from gym_mara.agents.evaluation.metrics import spread
        from gym_mara.agents.runs.evaluation import evaluate_run
        from gym_mara.agents.runs.folder import RunFolder

    options = keyword_arguments(settings)
    if baseline is not None:
        refuse(context, "--baseline plays no run", "run", "policy")
        backend, who = backend or own_backend(env), f"baseline {baseline}"
        metrics = evaluate_baseline(
            baseline, env, backend=backend, episodes=episodes, seed=seed, options=options
        )
    elif (file := exported_file(run, policy, env)) is not None:
        exported = OnnxPolicy(file)
        env, who = env if is_given(context, "env") else exported.about.env, f"policy {policy}"
        keywords = exported.keywords(env, backend, **options)
        backend = keywords["backend"]
        metrics = evaluate_exported(exported, env, keywords, episodes=episodes, seed=seed)
    elif run is not None:
        refuse(context, "the run has its own environment", "env")
        folder = RunFolder.open(run)
        env, who = folder.config.env, f"{policy} policy"
        backend = backend or folder.config.backend
        metrics = evaluate_run(
            folder, backend=backend, episodes=episodes, seed=seed, which=policy, options=options
        )
    else:
        raise GymMaraError(
            "give a run folder, --policy pretrained and --env, or --baseline ik and --env"
        )
    if as_json:
        print(json.dumps(spread(metrics), indent=2))
    else:
        print_metrics(f"{env} on {backend}, {who}, seed {seed}", metrics)


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


def export(
    run: RunArgument,
    file: Annotated[Path, typer.Argument(help="The new file, such as policy.onnx.")],
    policy: PolicyOption = "last",
) -> None:
    """Export a run's policy as one ONNX file, for a robot: gym_mara.deploy.OnnxPolicy plays it without torch.

    Needs the extra train.
    """
    with needs_agents():
        from gym_mara.agents.export.run import export as write
        from gym_mara.agents.runs.folder import RunFolder

    with interruptible("Interrupted; no file was written."):
        about = write(RunFolder.open(run), file, which=policy)
    out.print(f"{file}: {about.action.mode} actions for {about.robot.name}", soft_wrap=True)


def print_metrics(title: str, metrics: dict[str, Floats]) -> None:
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
