"""Profiles: in which form an arm takes commands and reports states, and on which topics. Data; nothing here needs ROS."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import dataclass
from typing import Literal

from gym_mara.errors import GymMaraError, positive_number, short, unknown

Commands = Literal["trajectory", "positions", "action"]
"""trajectory_msgs/JointTrajectory of one point, std_msgs/Float64MultiArray, or goals of control_msgs/FollowJointTrajectory."""
States = Literal["joint_states", "controller_state"]
"""sensor_msgs/JointState, or control_msgs/JointTrajectoryControllerState."""

JOINT_STATES = "joint_states"
"""The topic of ros2_control's joint_state_broadcaster."""
DESCRIPTION = "robot_description"
"""The topic of the URDF."""
MARA_VELOCITY = 0.5
"""The velocity that gym-gazebo2 commands by default, rad/s."""
LONGEST_TOPIC = 200
"""The longest name of a topic, characters: DDS allows some more, of which ROS needs some itself."""
_TOPIC = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@dataclass(frozen=True)
class Profile:
    """How to speak to an arm. `make_profile` makes one, with its topics."""

    name: str
    commands: Commands
    """The form of commands."""
    command_topic: str
    """The topic of commands, or the name of the action."""
    states: States
    """The form of states."""
    state_topic: str
    """The topic of states."""
    periods: float | None = 2.0
    """The time_from_start of a point, in control periods: with less than one, a controller stops between two points, and the arm
    jerks."""
    seconds: float | None = None
    """The time_from_start of a point, s; None where `periods` says it."""
    velocity: float | None = None
    """The velocity of every joint in every point, rad/s; None for points without velocities: a joint_trajectory_controller refuses a last
    point with a velocity unless allow_nonzero_velocity_at_trajectory_end is set."""
    best_effort: bool = False
    """Whether commands are published best effort, as sensor data, and not reliably. States are always read best effort, which
    both kinds of publishers can serve."""
    joints: tuple[str, ...] | None = None
    """The joints that the arm must have; None for any."""

    def duration(self, period: float) -> float:
        """The time_from_start of a point, s.

        Args:
            period: the control period, s.
        """
        return self.seconds if self.seconds is not None else (self.periods or 0.0) * period

    def check(self, joint_names: tuple[str, ...]) -> None:
        """Check that an arm with these joints can be commanded.

        Raises:
            GymMaraError: it cannot.
        """
        if self.joints is not None and joint_names != self.joints:
            raise GymMaraError(
                f"the profile {self.name!r} is for an arm with the joints {', '.join(self.joints)}, in this order, and the robot "
                f"has {', '.join(joint_names)}: choose another profile"
            )

    def with_joint_states(self) -> Profile:
        """This profile with sensor_msgs/JointState as the states, for where control_msgs is not installed."""
        if self.states == "joint_states":
            return self
        topic = f"{self._namespace}/{JOINT_STATES}"
        return dataclasses.replace(self, states="joint_states", state_topic=topic)

    @property
    def topics(self) -> tuple[str, ...]:
        """The topics of the arm: states, commands and the description. The goals of an action are on none."""
        commands = () if self.commands == "action" else (self.command_topic,)
        return (self.state_topic, *commands, f"{self._namespace}/{DESCRIPTION}")

    def of_policy(self, name: str) -> str:
        """The name of what a policy that is deployed on the arm offers: its topic "target", its services "stop" and "resume"."""
        return f"{self._namespace}/gym_mara/{name}"

    @property
    def _namespace(self) -> str:
        return self.command_topic.rsplit("/", 2)[0]


_MARA_JOINTS = ("motor1", "motor2", "motor3", "motor4", "motor5", "motor6")
# The topics below are relative: the controller's name, then the namespace come before them. The first value is the default
# name of the controller.
_PROFILES = {
    "trajectory": (
        "joint_trajectory_controller",
        Profile("trajectory", "trajectory", "joint_trajectory", "joint_states", JOINT_STATES),
    ),
    "forward": (
        "forward_position_controller",
        Profile("forward", "positions", "commands", "joint_states", JOINT_STATES),
    ),
    "action": (
        "joint_trajectory_controller",
        Profile("action", "action", "follow_joint_trajectory", "joint_states", JOINT_STATES),
    ),
    "mara-2019": (
        "mara_controller",
        Profile(
            "mara-2019",
            "trajectory",
            "command",
            "controller_state",
            "state",
            periods=None,
            seconds=0.001,
            velocity=MARA_VELOCITY,
            best_effort=True,
            joints=_MARA_JOINTS,
        ),
    ),
}
PROFILES = tuple(_PROFILES)
"""The names of the profiles."""


def make_profile(
    name: str = "trajectory",
    *,
    controller: str | None = None,
    namespace: str = "",
    command_topic: str | None = None,
    state_topic: str | None = None,
    velocity: float | None = None,
) -> Profile:
    """A profile by its name, with its topics.

    "trajectory" is ros2_control's joint_trajectory_controller, by its topic; "action" the same controller, by its action;
    "forward" is a forward_command_controller of positions; "mara-2019" are the topics of gym-gazebo2's MARAReal.

    Args:
        name: one of PROFILES.
        controller: the controller's name, which is part of its topics; by default the usual one.
        namespace: what comes before all topics, such as "robot1".
        command_topic, state_topic: other topics than these say, as they are.
        velocity: of "mara-2019": the velocity of every joint in every command, rad/s; by default 0.5, as in gym-gazebo2.

    Raises:
        GymMaraError: the profile is unknown, a name is no name of ROS, or the profile has no such velocity.
    """
    if not isinstance(name, str) or name not in _PROFILES:
        raise unknown("profile", name, PROFILES)
    usual, form = _PROFILES[name]
    speed = form.velocity
    if velocity is not None:
        if speed is None:
            raise GymMaraError(f"the profile {name!r} commands positions alone: leave out velocity")
        speed = positive_number("velocity", velocity, "rad/s")
    own = usual if controller is None else controller
    state = f"{own}/{form.state_topic}" if form.states == "controller_state" else form.state_topic
    return dataclasses.replace(
        form,
        command_topic=_topic("command_topic", command_topic, namespace, own, form.command_topic),
        state_topic=_topic("state_topic", state_topic, namespace, state),
        velocity=speed,
    )


def _topic(what: str, given: str | None, *parts: str) -> str:
    """The topic that was given, or the one of these parts; with a slash before it.

    Raises:
        GymMaraError: it is no name of ROS.
    """
    for part in parts if given is None else (given,):
        if not isinstance(part, str):
            raise GymMaraError(f"{what} must be the name of a topic, not {short(part)}")
    joined = "/".join(part.strip("/") for part in parts if part) if given is None else given
    topic = joined if joined.startswith("/") else f"/{joined}"
    if _TOPIC.fullmatch(topic) is None or "__" in topic:
        raise GymMaraError(
            f"{what} {short(topic, 200)} is no name of ROS: it needs letters, digits and underscores between slashes, with no "
            "digit first and no two underscores together, such as /arm/joint_states; check controller and namespace too"
        )
    if len(topic) > LONGEST_TOPIC:
        raise GymMaraError(
            f"{what} has {len(topic)} characters with controller and namespace, and may have {LONGEST_TOPIC}: {short(topic, 80)}"
        )
    return topic
