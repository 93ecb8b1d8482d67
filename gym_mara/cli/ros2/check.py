"""gym-mara ros2 check: whether an arm is ready."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Column, Table
from rich.text import Text

from gym_mara.cli.common import interruptible, number, out
from gym_mara.cli.ros2.options import (
    CommandTopicOption,
    ControllerOption,
    DomainOption,
    NamespaceOption,
    ProfileOption,
    RobotOption,
    StateTopicOption,
    profile_of,
)
from gym_mara.deploy import OnnxPolicy
from gym_mara.files import write_json
from gym_mara.robot import RobotModel


def check(
    policy: Annotated[
        Path | None,
        typer.Argument(help="An exported policy, whose joints and robot are compared."),
    ] = None,
    robot: RobotOption = "mara",
    profile: ProfileOption = "trajectory",
    controller: ControllerOption = None,
    namespace: NamespaceOption = "",
    command_topic: CommandTopicOption = None,
    state_topic: StateTopicOption = None,
    domain: DomainOption = None,
    seconds: Annotated[
        float,
        typer.Option(parser=number(0.5, 600.0), metavar="X", help="How long to listen, s."),
    ] = 2.0,
    as_json: Annotated[
        Path | None,
        typer.Option(
            "--json",
            help="Write a new file with the lines and the figures; its latency is a range for randomisation.",
        ),
    ] = None,
) -> None:
    """Check an arm before it moves: who is there, rates, joints, limits, clocks, delays. Nothing is commanded.

    The exit code is 1 if something is wrong. Needs the extra ros2.
    """
    from gym_mara.ros2.check import check as check_arm

    chosen = profile_of(profile, controller, namespace, command_topic, state_topic)
    about = None if policy is None else OnnxPolicy(policy).about
    model = RobotModel.load(robot)
    with interruptible("Interrupted."):
        report = check_arm(model, chosen, about, seconds=seconds, domain=domain)
    table = Table("", "", Column("found", overflow="fold"), Column("to do", overflow="fold"))
    for line in report.lines:
        mark = Text("ok", "green") if line.ok else Text("wrong", "bold red")
        table.add_row(mark, line.what, line.found, "" if line.ok else line.remedy)
    out.print(table)
    latency = report.figures["latency"]
    if latency is not None and report.ok:
        ends = ", ".join(f"{value:.4f}" for value in latency)
        out.print(f"for training: --set 'randomisation={{\"latency\": [{ends}]}}'", soft_wrap=True)
    if as_json is not None:
        values = {
            "ok": report.ok,
            "lines": [line._asdict() for line in report.lines],
            **report.figures,
        }
        write_json(as_json, values, new=True)
    if not report.ok:
        raise typer.Exit(1)
