"""What the commands for ROS 2 share: the options for the robot, the domain and the profile."""

from __future__ import annotations

from typing import Annotated

import typer

from gym_mara.cli.common import one_of, whole
from gym_mara.ros2.profiles import PROFILES, Profile, make_profile

profile_name = one_of("profile", lambda: PROFILES)

RobotOption = Annotated[
    str,
    typer.Option(metavar="ROBOT", help="A URDF, or the name of a robot that gym-mara list shows."),
]
DomainOption = Annotated[
    int | None,
    typer.Option(
        parser=whole(0, 232), metavar="N", help="The ROS domain; by default that of ROS_DOMAIN_ID."
    ),
]
ProfileOption = Annotated[
    str,
    typer.Option(
        parser=profile_name,
        metavar="NAME",
        help="How to speak to the arm: " + ", ".join(PROFILES) + ".",
    ),
]
ControllerOption = Annotated[
    str | None,
    typer.Option(metavar="NAME", help="The controller; by default the usual one of the profile."),
]
NamespaceOption = Annotated[
    str, typer.Option(metavar="NAME", help="What comes before the names of all topics.")
]
CommandTopicOption = Annotated[
    str | None, typer.Option(metavar="TOPIC", help="The topic of the commands, as it is.")
]
StateTopicOption = Annotated[
    str | None, typer.Option(metavar="TOPIC", help="The topic of the states, as it is.")
]


def profile_of(
    name: str,
    controller: str | None,
    namespace: str,
    command_topic: str | None,
    state_topic: str | None,
) -> Profile:
    """The profile that these options describe.

    Raises:
        GymMaraError: a name is no name of ROS.
    """
    return make_profile(
        name,
        controller=controller,
        namespace=namespace,
        command_topic=command_topic,
        state_topic=state_topic,
    )
