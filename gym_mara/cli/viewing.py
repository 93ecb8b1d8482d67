"""gym-mara watch and report: see what an agent does."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.cli.common import (
    EnvOption,
    SetOption,
    interruptible,
    keyword_arguments,
    needs_agents,
    out,
    task_name,
)
from gym_mara.errors import GymMaraError, positive_number

PolicyOption = Annotated[
    str, typer.Option(help="last, or best: the one that did best when evaluated.")
]


def watch(
    run: Annotated[
        Path | None, typer.Argument(help="A run folder; without one, move the arm by hand.")
    ] = None,
    env: EnvOption = "MARA-v0",
    backend: Annotated[
        str | None,
        typer.Option(
            help="Backend; by default the run's own. For a video several, with commas between them."
        ),
    ] = None,
    policy: PolicyOption = "last",
    video: Annotated[
        Path | None, typer.Option(help="New file, .mp4 or .gif, instead of the browser.")
    ] = None,
    speed: Annotated[
        float, typer.Option(help="How much faster than real time; in the browser from 0.1 to 5.")
    ] = 1.0,
    seconds: Annotated[float, typer.Option(help="How much of the episode a video shows, s.")] = 6.0,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Watch a run's policy in the browser, or film it; without a run, move the arm by hand."""
    options = keyword_arguments(settings)
    positive_number("--speed", speed)
    positive_number("--seconds", seconds, "s")
    if run is None and video is not None:
        raise GymMaraError("--video films a run's policy: name the run folder")
    if run is None:
        from gym_mara.viewer import watch as open_viewer

        # Who jogs the arm into the table wants to see it there, and not back at home.
        keywords = {"on_collision": "continue", **options}
        with interruptible("Closed."):
            open_viewer(task_name(env), backend or DEFAULT_BACKEND, keywords, speed=speed)
        return
    with needs_agents():
        from gym_mara.agents.inspection.watch import film_run, watch_run
        from gym_mara.agents.runs.folder import RunFolder

    folder = RunFolder.open(run)
    backends = (backend or folder.config.backend).split(",")
    if video is not None:
        with interruptible("Interrupted; no video was written."):
            film_run(folder, video, backends, options, which=policy, seconds=seconds, speed=speed)
        out.print(str(video), soft_wrap=True)
        return
    if len(backends) > 1:
        raise GymMaraError("the browser shows one backend at a time, and can switch; name one")
    with interruptible("Closed."):
        watch_run(folder, backends[0], options, policy, speed)


def report(
    run: Annotated[Path, typer.Argument(help="A run folder.")],
    policy: PolicyOption = "last",
    out_file: Annotated[
        Path | None,
        typer.Option("--out", help="The page; by default report.html in the run folder."),
    ] = None,
) -> None:
    """Write a page about a run: curves, an episode on every backend, the tool's path, a video, the configuration."""
    with needs_agents():
        from gym_mara.agents.inspection.report import write_report
        from gym_mara.agents.runs.folder import RunFolder

    with interruptible("Interrupted; no report was written."):
        out.print(str(write_report(RunFolder.open(run), out_file, which=policy)), soft_wrap=True)
