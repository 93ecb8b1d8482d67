"""gym-mara watch and report: look at a policy."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gym_mara.cli.common import (
    EnvOption,
    SetOption,
    backend_name,
    interruptible,
    is_given,
    keyword_arguments,
    names_in,
    needs_agents,
    number,
    out,
    refuse,
    several,
    whole,
)
from gym_mara.cli.policies import AnyPolicyOption, PolicyOption, exported_file
from gym_mara.errors import GymMaraError
from gym_mara.registration import own_backend

if TYPE_CHECKING:
    from gym_mara.agents.inspection.watch import Show

VIEWER_SPEEDS, VIDEO_SPEEDS = (0.1, 5.0), (0.01, 100.0)
"""The lowest and the highest speed, times real time."""


def watch(
    context: typer.Context,
    run: Annotated[
        Path | None,
        typer.Argument(help="A run folder; without one and without --policy, jog the joints."),
    ] = None,
    env: EnvOption = "MARA-v0",
    backend: Annotated[
        list[str] | None,
        typer.Option(
            parser=several(backend_name),
            metavar="NAMES",
            help="Backend; by default that of the training. A video may show several, separated by commas.",
        ),
    ] = None,
    policy: AnyPolicyOption = "last",
    video: Annotated[
        Path | None,
        typer.Option(help="Write a new file, .mp4 or .gif, instead of opening the viewer."),
    ] = None,
    speed: Annotated[
        float,
        typer.Option(
            parser=number(*VIDEO_SPEEDS),
            metavar="X",
            help="Times real time; the viewer allows {:g} to {:g}.".format(*VIEWER_SPEEDS),
        ),
    ] = 1.0,
    seconds: Annotated[
        float,
        typer.Option(
            parser=number(0.1, 3600.0),
            metavar="X",
            help="Length of the episode that a video shows, s.",
        ),
    ] = 6.0,
    targets: Annotated[
        int | None,
        typer.Option(
            parser=whole(1, 100),
            metavar="N",
            help="Instead of one episode, a video shows so many random targets in a row, without a reset.",
        ),
    ] = None,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Watch a policy in the browser, or film it; without a policy, jog the joints.

    Needs the extra render, with a run or --video also the extra train, and with an exported policy the extra deploy.
    """
    file = exported_file(run, policy, env)
    _refuse_what_has_no_effect(context, run, file)
    if video is None and not VIEWER_SPEEDS[0] <= speed <= VIEWER_SPEEDS[1]:
        raise GymMaraError(
            "--speed of the viewer must be from {:g} to {:g}, not {:g}".format(
                *VIEWER_SPEEDS, speed
            )
        )
    options = keyword_arguments(settings, pictures=video is not None, viewer=video is None)
    chosen = names_in("--backend", backend or [])
    if video is None and len(chosen) > 1:
        raise GymMaraError(
            "the viewer shows one backend at a time, and can switch: give one --backend"
        )
    if targets is not None and len(chosen) > 1:
        raise GymMaraError("a video of several targets shows one backend: give one --backend")
    name = env if is_given(context, "env") else None
    if video is not None:
        with needs_agents():
            from gym_mara.agents.inspection.watch import film_episode, film_targets

        with interruptible("Interrupted; no video was written."):
            show = _show(run, policy, file, name)
            backends = chosen or [show.backend]
            if targets is None:
                film = partial(film_episode, show, video, list(backends), seconds=seconds)
            else:
                film = partial(film_targets, show, video, backends[0], targets=targets)
            film(options=options, speed=speed, log=_print)
        out.print(str(video), soft_wrap=True)
        return
    with interruptible("Closed."):
        if file is not None:
            from gym_mara.viewer.exported import watch_exported

            one = chosen[0] if chosen else None
            watch_exported(file, name, one, options, speed, _print)
        elif run is None:
            from gym_mara.viewer import watch as open_viewer

            # A user who jogs the arm into the table should see it there, not reset to its start.
            keywords = {"on_collision": "continue", **options}
            open_viewer(env, chosen[0] if chosen else own_backend(env), keywords, speed=speed)
        else:
            with needs_agents():
                from gym_mara.agents.inspection.watch import watch_run
                from gym_mara.agents.runs.folder import RunFolder

            folder = RunFolder.open(run)
            backend_shown = chosen[0] if chosen else folder.config.backend
            watch_run(folder, backend_shown, options, policy, speed, _print)


def _show(run: Path | None, policy: str, file: Path | None, env: str | None) -> Show:
    """What a video shows: a policy of a run, or the exported policy of a file."""
    from gym_mara.agents.inspection.watch import show_exported, show_run
    from gym_mara.agents.runs.folder import RunFolder
    from gym_mara.deploy import OnnxPolicy

    if file is not None:
        return show_exported(OnnxPolicy(file), env)
    assert run is not None
    return show_run(RunFolder.open(run), policy)


def _refuse_what_has_no_effect(context: typer.Context, run: Path | None, file: Path | None) -> None:
    """Refuse the options of `watch` that mean nothing with this run or this exported policy, or without any."""
    if run is None and file is None:
        names = "policy", "video", "targets"
        refuse(
            context, "without a run folder or an exported policy there is no policy to play", *names
        )
    elif run is not None:
        refuse(context, "a run has its own environment", "env")
    if not is_given(context, "video"):
        refuse(context, "the viewer has no end; only --video has a length", "seconds", "targets")
    if is_given(context, "targets"):
        refuse(context, "a video of several targets ends after the last one", "seconds")


def _print(note: str) -> None:
    out.print(note, soft_wrap=True)


def report(
    run: Annotated[Path, typer.Argument(help="A run folder.")],
    policy: PolicyOption = "last",
    out_file: Annotated[
        Path | None,
        typer.Option("--out", help="The page; by default report.html in the run folder."),
    ] = None,
) -> None:
    """Write an HTML page about a run: curves, an episode on every backend, the tool's path, a video, the configuration.

    Needs the extras train and render.
    """
    with needs_agents():
        from gym_mara.agents.inspection.report import write_report
        from gym_mara.agents.runs.folder import RunFolder

    with interruptible("Interrupted; no report was written."):
        out.print(str(write_report(RunFolder.open(run), out_file, which=policy)), soft_wrap=True)
