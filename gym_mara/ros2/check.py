"""`gym-mara ros2 check`: whether an arm behind topics is ready for a policy, and how late its states are."""

from __future__ import annotations

import os
import time
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from gym_mara.deploy.about import About
from gym_mara.robot import RobotModel
from gym_mara.robot.fingerprint import fingerprint
from gym_mara.ros2 import graph, messages
from gym_mara.ros2.joints import LATE, LATE_WINDOW, UNKNOWN
from gym_mara.ros2.link import DISCOVERY, RosLink
from gym_mara.ros2.node import RosNode, needs_ros
from gym_mara.ros2.profiles import Profile
from gym_mara.ros2.safety import Watchdogs
from gym_mara.types import Floats

with needs_ros("the check of an arm"):
    from std_msgs.msg import Float64MultiArray

LONGEST_GAP = Watchdogs.state_age
"""The longest time between two states, s: the safety filter stops the arm after a longer one."""
SLOWEST = 2.0 / LONGEST_GAP
"""The lowest rate of states, Hz; a policy may need a higher one."""
CLOCKS_AGREE = (-0.005, 1.0)
"""The ages of states between which the clocks of sender and receiver agree, s."""
CLOCK_ERROR = (0.6 * LATE / LATE_WINDOW, 0.02)
"""How much the clock of the sender may be slower or faster than real time: a part of it, and s in all, for late states. With a clock
that is slower by LATE / LATE_WINDOW, states are refused as late."""
OLDEST = 0.1
"""The highest age of states, s, at the 95th percentile."""
_WAITING = 3.0
"""How long to wait for the first state, s."""
_PROBES = 0.01
"""The time between two messages that measure the transport, s."""


class Line(NamedTuple):
    """A thing that was checked."""

    ok: bool
    what: str
    """Its name."""
    found: str
    """What was found."""
    remedy: str = ""
    """What to do if it is not right."""


@dataclass(frozen=True)
class Report:
    """What a check found."""

    lines: tuple[Line, ...]
    figures: dict[str, Any]
    """What was measured, as JSON has it: times in s, percentiles 5, 50 and 95. `latency` is [lowest, highest], as
    `randomisation` takes it; None without states."""

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong."""
        return all(line.ok for line in self.lines)


class _Arrival(NamedTuple):
    received: float
    age: float
    stamp: float
    names: tuple[str, ...]


@dataclass
class _Measured:
    """What was heard while the check listened."""

    arrivals: list[_Arrival] = field(default_factory=list)
    transport: list[float] = field(default_factory=list)
    positions: list[Floats] = field(default_factory=list)


def check(
    robot: RobotModel,
    profile: Profile,
    about: About | None = None,
    *,
    seconds: float = 2.0,
    domain: int | None = None,
) -> Report:
    """Check an arm; nothing is commanded, and no publisher of commands is made.

    The latency is the age of the states when they arrive, plus a period: the policy's control period, or without a policy
    the time between two states. Where the clocks do not agree, the time of the transport on this machine stands for the age.

    Args:
        robot: the arm.
        profile: how to speak to it.
        about: the policy that shall move it; None for none.
        seconds: how long to listen, s.
        domain: the ROS domain; by default that of ROS_DOMAIN_ID, or 0.

    Raises:
        GymMaraError: the profile is not for this robot, or needs messages that are not installed.
        MissingExtraError: rclpy is not installed.
    """
    with (
        closing(RosNode("gym_mara_check", domain=domain)) as ros,
        closing(RosLink(robot, profile, node=ros, commands=False)) as link,
    ):
        measured = _listen(ros, link, seconds)
        lines, figures = _of_states(robot, link, measured, about)
        lines += _of_commands(link)
    lines += _of_policy(robot, about)
    transport = _percentiles(measured.transport)
    figures["transport"] = transport
    lines.append(_transport_line(transport))
    return Report(tuple(lines), {**figures, "latency": _latency(figures, about)})


def _listen(ros: RosNode, link: RosLink, seconds: float) -> _Measured:
    """Listen to the states, and measure the transport on a topic of this process alone."""
    measured, node = _Measured(), ros.node

    def on_state(message: Any) -> None:
        received, now = time.monotonic(), ros.now()
        joints = link.parse(message)
        age = now - joints.stamp
        measured.arrivals.append(_Arrival(received, age, joints.stamp, tuple(joints.names)))

    def on_probe(message: Any) -> None:
        measured.transport.append(time.monotonic() - message.data[0])

    topic = f"/gym_mara_check/process{os.getpid()}"
    probes = node.create_publisher(Float64MultiArray, topic, messages.RELIABLE)
    node.create_subscription(Float64MultiArray, topic, on_probe, messages.RELIABLE)
    node.create_subscription(
        link.state_type, link.profile.state_topic, on_state, messages.SENSOR_DATA
    )
    began = time.monotonic()
    while (now := time.monotonic() - began) < _WAITING:
        if measured.arrivals and now >= DISCOVERY:
            break
        time.sleep(_PROBES)
    measured.arrivals.clear()
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        probes.publish(Float64MultiArray(data=[time.monotonic()]))
        if (state := link.state) is not None:
            measured.positions.append(state.q)
        time.sleep(_PROBES)
    return measured


def _of_states(
    robot: RobotModel, link: RosLink, measured: _Measured, about: About | None
) -> tuple[list[Line], dict[str, Any]]:
    """The lines about the states, and the figures."""
    topic = link.profile.state_topic
    found = graph.publishers(link.node.node, topic)
    problems = link.state_problems()
    who = graph.described(found) or "nobody"
    lines = [Line(not problems, "states", f"{topic}, published by {who}", "; ".join(problems))]
    lines += [Line(True, "note", note) for note in link.notes]
    arrivals = _own(robot, measured.arrivals)
    if len(arrivals) < 2:
        return lines, {"rate": 0.0}
    gaps = np.diff([arrival.received for arrival in arrivals])
    rate = len(gaps) / float(gaps.sum())
    wanted = SLOWEST if about is None else max(SLOWEST, 0.9 / about.control_period)
    figures: dict[str, Any] = {"rate": rate, "gaps": _percentiles(gaps)}
    lines += [
        Line(
            rate >= wanted,
            "rate",
            f"{rate:.4g} states a second",
            f"at least {wanted:.3g} are needed: raise the rate of the joint_state_broadcaster (update_rate)",
        ),
        Line(
            float(gaps.max()) <= LONGEST_GAP,
            "jitter",
            f"a state each {_in_ms(figures['gaps'])}; the longest gap {1e3 * gaps.max():.1f} ms",
            "the network or a machine is too busy",
        ),
        _joints_line(robot, link, arrivals),
    ]
    if measured.positions:
        lines.append(_limits_line(robot, np.array(measured.positions)))
    clock, age = _clock_line(arrivals)
    lines.append(clock)
    figures["age"] = age
    if age is not None:
        remedy = "the states come late: use a wired network, or raise their rate"
        lines.append(Line(age[2] <= OLDEST, "age of states", _in_ms(age), remedy))
    return lines, figures


def _own(robot: RobotModel, arrivals: list[_Arrival]) -> list[_Arrival]:
    """The messages with all joints of the robot, without those of others on the topic, such as a gripper; all, if none has them."""
    own = [each for each in arrivals if set(robot.joint_names) <= set(each.names)]
    return own or arrivals


def _joints_line(robot: RobotModel, link: RosLink, arrivals: list[_Arrival]) -> Line:
    names, refused = arrivals[-1].names, dict(link.refused)
    if link.state is not None:
        refused.pop(UNKNOWN, None)  # of others on the topic
    if refused:
        why = ", ".join(f"{number} {reason}" for reason, number in refused.items())
        found = f"{sum(refused.values())} states refused: {why}"
        return Line(False, "joints", found, link.last_refusal or "")
    own = [name for name in names if name in robot.joint_names]
    order = "the order of the robot" if tuple(own) == robot.joint_names else "another order"
    other = len(names) - len(own)
    more = f", and {other} others, which are ignored" if other else ""
    return Line(True, "joints", f"all {len(own)}, by name, in {order}{more}")


def _limits_line(robot: RobotModel, q: Floats) -> Line:
    room = np.minimum(q - robot.lower, robot.upper - q).min(0)
    joint = int(room.argmin())
    name, worst = robot.joint_names[joint], float(room[joint])
    if worst >= 0.0:
        return Line(True, "limits", f"kept; {name} is the nearest, with {worst:.3g} rad (m) left")
    remedy = "move it back by hand, or correct the zero of the joint or the limits in the URDF"
    return Line(False, "limits", f"{name} is {-worst:.3g} rad (m) beyond its own", remedy)


def _clock_line(arrivals: list[_Arrival]) -> tuple[Line, list[float] | None]:
    """The line about the sender's clock, and the percentiles of the states' age if the clocks agree."""
    stamps = np.array([arrival.stamp for arrival in arrivals])
    if not stamps.any():
        return Line(True, "clock", "the states have no stamps; their age is not known"), None
    passed, speed = _clock_speed(arrivals)
    if abs(speed - 1.0) > CLOCK_ERROR[0] + CLOCK_ERROR[1] / passed:
        found = f"that of the sender runs at {speed:.3g} times real time"
        remedy = "it must advance in real time: start the clock or the simulation, or let it run at its speed"
        return Line(False, "clock", found, remedy), None
    age = _percentiles([arrival.age for arrival in arrivals])
    if CLOCKS_AGREE[0] <= age[1] <= CLOCKS_AGREE[1]:
        found = (
            f"advances; an offset cannot be more than the age of the states, {1e3 * age[1]:.1f} ms"
        )
        return Line(True, "clock", found), [max(0.0, value) for value in age]
    if stamps[-1] < 1e9 / 4:
        return Line(
            True, "clock", "advances, and is simulated; the age of states is not known"
        ), None
    side = "behind" if age[1] > 0.0 else "ahead of"
    found = f"that of the sender is {abs(age[1]):.3f} s {side} that of this machine"
    return Line(False, "clock", found, "set both by the same server of time (chrony)"), None


def _clock_speed(arrivals: list[_Arrival]) -> tuple[float, float]:
    """Over which time the sender's clock was measured, s, and how fast it runs, in times real time.

    Late states count as little as possible: the fastest of the first and of the last third are compared.
    """
    third = -(-len(arrivals) // 3)
    begin, end = (
        min(some, key=lambda each: each.received - each.stamp)
        for some in (arrivals[:third], arrivals[-third:])
    )
    passed = end.received - begin.received
    return passed, (end.stamp - begin.stamp) / passed


def _of_commands(link: RosLink) -> list[Line]:
    topic = link.profile.command_topic
    problems = link.command_problems()
    who = graph.described(found := graph.subscribers(link.node.node, topic)) or "nobody"
    lines = [Line(not problems, "commands", f"{topic}, heard by {who}", "; ".join(problems))]
    silent = sorted({endpoint.node for endpoint in found} - link.orders.keys())
    if silent and link.profile.commands == "positions":
        own = ", ".join(link.robot.joint_names)
        note = f"{', '.join(silent)} does not tell its joints: compare them, and their order, with {own}"
        lines.append(Line(True, "note", note))
    return lines


def _of_policy(robot: RobotModel, about: About | None) -> list[Line]:
    if about is None:
        return []
    theirs = tuple(joint.name for joint in about.robot.joints)
    same = about.robot.fingerprint == fingerprint(robot)
    return [
        Line(
            theirs == robot.joint_names,
            "policy's joints",
            ", ".join(theirs),
            f"the robot has {', '.join(robot.joint_names)}: give --robot the robot of the training",
        ),
        Line(
            same,
            "policy's robot",
            f"{about.robot.name}, {'the same' if same else 'not the same'} as {robot.name}",
            "give --robot the robot of the training, or train a policy for this one",
        ),
    ]


def _transport_line(transport: list[float] | None) -> Line:
    if transport is None:
        return Line(False, "transport", "nothing arrived", "is a firewall on this machine?")
    remedy = "this machine is too busy: end other programs"
    return Line(transport[2] <= OLDEST / 2.0, "transport", _in_ms(transport), remedy)


def _latency(figures: dict[str, Any], about: About | None) -> list[float] | None:
    late = figures.get("age") or figures["transport"]
    if not figures["rate"] or late is None:
        return None
    period = 1.0 / figures["rate"] if about is None else about.control_period
    return [late[0] + period, late[2] + period]


def _percentiles(values: Any) -> Any:
    """The percentiles 5, 50 and 95; None without values."""
    return np.percentile(values, [5.0, 50.0, 95.0]).tolist() if len(values) else None


def _in_ms(percentiles: list[float]) -> str:
    low, middle, high = (1e3 * value for value in percentiles)
    return f"{middle:.1f} ms ({low:.1f} to {high:.1f} ms from the 5th to the 95th percentile)"
