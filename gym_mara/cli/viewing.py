"""gym-mara watch and report: look at a policy."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.cli.common import (
    EnvOption,
    PolicyOption,
    SetOption,
    interruptible,
    keyword_arguments,
    needs_agents,
    out,
    task_name,
)
from gym_mara.errors import GymMaraError, positive_number


def watch(
    run: Annotated[
        Path | None, typer.Argument(help="A run folder; without one, jog the joints.")
    ] = None,
    env: EnvOption = "MARA-v0",
    backend: Annotated[
        str | None,
        typer.Option(
            help="Backend; by default that of the run. A video may show several, separated by commas."
        ),
    ] = None,
    policy: PolicyOption = "last",
    video: Annotated[
        Path | None,
        typer.Option(help="Write a new file, .mp4 or .gif, instead of opening the viewer."),
    ] = None,
    speed: Annotated[
        float, typer.Option(help="Times real time; the viewer allows 0.1 to 5.")
    ] = 1.0,
    seconds: Annotated[
        float, typer.Option(help="Length of the episode that a video shows, s.")
    ] = 6.0,
    settings: SetOption = [],  # noqa: B006 - Typer reads it and never changes it
) -> None:
    """Watch a run's policy in the browser, or film it; without a run, jog the joints."""
    options = keyword_arguments(settings)
    positive_number("--speed", speed)
    positive_number("--seconds", seconds, "s")
    if run is None and video is not None:
        raise GymMaraError("--video films a run's policy: give a run folder")
    if run is None:
        from gym_mara.viewer import watch as open_viewer

        # A user who jogs the arm into the table should see it there, not reset to its start.
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
            film_run(
                folder,
                video,
                backends,
                options,
                which=policy,
                seconds=seconds,
                speed=speed,
                log=_print,
            )
        out.print(str(video), soft_wrap=True)
        return
    if len(backends) > 1:
        raise GymMaraError(
            "the viewer shows one backend at a time, and can switch: give one --backend"
        )
    with interruptible("Closed."):
        watch_run(folder, backends[0], options, policy, speed, _print)


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
    """Write an HTML page about a run: curves, an episode on every backend, the tool's path, a video, the configuration."""
    with needs_agents():
        from gym_mara.agents.inspection.report import write_report
        from gym_mara.agents.runs.folder import RunFolder

    with interruptible("Interrupted; no report was written."):
        out.print(str(write_report(RunFolder.open(run), out_file, which=policy)), soft_wrap=True)
