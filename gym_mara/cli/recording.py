"""gym-mara record: episodes as a data set."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from gym_mara.cli.common import (
    EnvOption,
    RunBackendOption,
    SetOption,
    interruptible,
    is_given,
    keyword_arguments,
    needs_agents,
    one_of,
    out,
    refuse,
    whole,
)
from gym_mara.cli.policies import ONNX, PRETRAINED
from gym_mara.datasets.contents import LOWEST_PIXELS, MOST_PIXELS, checked_pixels
from gym_mara.datasets.formats import FORMATS, writer_class
from gym_mara.errors import GymMaraError
from gym_mara.pretrained import pretrained_file
from gym_mara.registration import own_backend

IK, HAND = "ik", "hand"


def record(
    context: typer.Context,
    policy: Annotated[
        str,
        typer.Option(
            metavar="RUN",
            help=f"What acts: a run folder, a file of gym-mara export, {PRETRAINED} (the policy of gym_mara for --env), "
            f"{IK} (inverse kinematics and a straight joint move), or {HAND} (you lead the arm in the viewer, until Ctrl-C).",
        ),
    ],
    out_folder: Annotated[Path, typer.Option("--out", help="New folder for the data set.")],
    env: EnvOption = "MARA-v0",
    backend: RunBackendOption = None,
    episodes: Annotated[
        int,
        typer.Option(parser=whole(1, 100_000), metavar="N", help="How many episodes to record."),
    ] = 10,
    seed: Annotated[
        int,
        typer.Option(
            parser=whole(0, 2**32 - 1),
            metavar="N",
            help="Seed of the episodes. None is an episode of an evaluation.",
        ),
    ] = 0,
    format: Annotated[  # noqa: A002 - the name of the option
        str,
        typer.Option(
            parser=one_of("format", lambda: FORMATS),
            metavar="NAME",
            help=f"Format: {' or '.join(FORMATS)}.",
        ),
    ] = FORMATS[0],
    pixels: Annotated[
        int | None,
        typer.Option(
            parser=whole(LOWEST_PIXELS, MOST_PIXELS),
            metavar="N",
            help="Also a picture of this width and height, an even number, at each step.",
        ),
    ] = None,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Record episodes as a data set for imitation learning: actions, observations, rewards, success, pictures.

    Needs the extra of the format, minari or lerobot, and train; by hand render in place of train; with pictures also render; and
    for an exported policy also deploy.
    """
    if os.path.lexists(out_folder):
        raise GymMaraError(f"{str(out_folder)!r} exists and is not overwritten: delete it first")
    by_hand = policy == HAND
    options = keyword_arguments(settings, pictures=pixels is not None, viewer=by_hand)
    if pixels is not None and (given := {"width", "height"} & options.keys()):
        raise GymMaraError(f"--pixels is the size of the pictures: leave out --set {min(given)}")
    if pixels is not None:
        checked_pixels(pixels)
    writer_class(format)
    common: dict[str, Any] = {"episodes": episodes, "seed": seed, "pixels": pixels}
    with interruptible("Interrupted; no data set was written."):
        if by_hand:
            from gym_mara.datasets.hand import record_by_hand

            name, chosen = env, backend or own_backend(env)
            made = record_by_hand(name, chosen, options, format, out_folder, **common, log=_print)
        else:
            with needs_agents():
                from gym_mara.datasets.playing import record as run

            source = _source(context, policy, env, backend, options)
            name = source.env
            made = run(source, format, out_folder, **common)
    share = ""
    if made.successes is not None:
        share = f", {100.0 * made.successes / made.episodes:.3g} % end in success"
    text = f"{out_folder}: {made.episodes:,} episodes of {name}, {made.steps:,} steps{share}"
    _print(text)


def _print(text: str) -> None:
    out.print(text, soft_wrap=True)


def _source(
    context: typer.Context, policy: str, env: str, backend: str | None, options: dict[str, Any]
) -> Any:
    """What acts, as a `gym_mara.datasets.sources.Source`."""
    from gym_mara.datasets import sources

    if policy == IK:
        return sources.baseline(IK, env, backend or own_backend(env), options)
    if policy == PRETRAINED or policy.endswith(ONNX):
        file = pretrained_file(env) if policy == PRETRAINED else Path(policy)
        name = env if is_given(context, "env") or policy == PRETRAINED else None
        return sources.exported(file, name, backend, options)
    if not os.path.isdir(policy):
        raise GymMaraError(
            f"--policy {policy!r} is no run folder, and neither {IK}, {HAND}, {PRETRAINED} nor a file that ends in {ONNX}"
        )
    refuse(context, "the run has its own environment", "env")
    return sources.of_run(Path(policy), backend, options)
