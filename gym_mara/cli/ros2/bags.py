"""gym-mara ros2 record and replay: bags of an arm's topics."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from gym_mara.cli.common import err, number, out, refuse
from gym_mara.cli.ros2.options import (
    ControllerOption,
    DomainOption,
    NamespaceOption,
    RobotOption,
    profile_name,
)
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.profiles import PROFILES, make_profile


def record(
    context: typer.Context,
    bag: Annotated[Path, typer.Argument(help="New folder for the bag.")],
    topic: Annotated[
        list[str],
        typer.Option(
            metavar="NAME",
            help="Topic to record; by default, and without --profile, all with joint states, commands, targets or diagnostics.",
        ),
    ] = [],  # noqa: B006 - Typer reads it and never changes it
    profile: Annotated[
        str | None,
        typer.Option(
            parser=profile_name,
            metavar="NAME",
            help="Record the topics of the arm that is spoken to so, and of a policy on it: "
            + ", ".join(PROFILES)
            + ".",
        ),
    ] = None,
    robot: RobotOption = "mara",
    controller: ControllerOption = None,
    namespace: NamespaceOption = "",
    seconds: Annotated[
        float | None,
        typer.Option(
            parser=number(0.1, 1e6),
            metavar="X",
            help="How long from the first message on, s; by default until Ctrl-C.",
        ),
    ] = None,
    domain: DomainOption = None,
) -> None:
    """Record the topics of an arm as a bag in MCAP, which the tools of ROS can read.

    After a kill the bag can still be read, but for about the last second. Needs the extra ros2.
    """
    from gym_mara.ros2.bags.recording import lacking_joints, topics_of
    from gym_mara.ros2.bags.recording import record as run

    wanted, model = tuple(f"/{name.lstrip('/')}" for name in topic), None
    if profile is None:
        refuse(context, "it has no effect without --profile", "robot", "controller", "namespace")
    else:
        chosen = make_profile(profile, controller=controller, namespace=namespace)
        model = RobotModel.load(robot)
        chosen.check(model.joint_names)
        topics, notes = topics_of(chosen)
        wanted = tuple(dict.fromkeys((*topics, *wanted)))
        for note in notes:
            err.print(f"note: {note}.", soft_wrap=True)
    if bag.exists():
        raise GymMaraError(f"{str(bag)!r} exists and is not overwritten: delete it first")
    err.print("Recording; stop with Ctrl-C.")

    def absent(topics: list[str]) -> None:
        err.print(f"note: not there yet: {', '.join(topics)}.", soft_wrap=True)

    counts = run(bag, wanted, seconds, domain=domain, absent=absent)
    missing = [name for name in wanted if name not in counts]
    _print(f"Recorded in {bag}", counts)
    if missing:
        out.print(f"not found: {', '.join(missing)}", soft_wrap=True)
    if not any(counts.values()):
        raise GymMaraError(
            f"no messages came: {str(bag)!r} is empty; is the arm there, and in the same ROS_DOMAIN_ID?"
        )
    states = wanted[0] if wanted else ""
    if model is not None and counts.get(states) and (lacking := lacking_joints(bag, states, model)):
        out.print(
            f"the states on {states} lack {', '.join(lacking)} of {model.name}: give --robot the robot that is there",
            soft_wrap=True,
        )


def replay(
    bag: Annotated[Path, typer.Argument(help="Folder of a bag.")],
    rate: Annotated[
        float, typer.Option(parser=number(0.01, 100.0), metavar="X", help="Times as fast.")
    ] = 1.0,
    domain: DomainOption = None,
) -> None:
    """Publish the states, commands and targets of a bag on the topics /replay/…, for looking at them.

    No arm is moved. Needs the extra ros2.
    """
    from gym_mara.ros2.bags.recording import PREFIX
    from gym_mara.ros2.bags.recording import replay as run

    err.print(f"Replaying on {PREFIX}/…, which no arm listens to.")
    _print(f"Replayed from {bag}", run(bag, rate, domain=domain))


def _print(title: str, counts: dict[str, int]) -> None:
    table = Table("topic", "messages", title=title)
    for topic, count in sorted(counts.items()):
        table.add_row(topic, f"{count:,}")
    out.print(table)
