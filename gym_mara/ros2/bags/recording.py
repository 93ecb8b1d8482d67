"""Records topics of ROS 2 as a bag, and plays a bag on topics of its own."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from importlib import import_module
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any

from gym_mara.errors import GymMaraError, short
from gym_mara.files import read_text
from gym_mara.robot import RobotModel
from gym_mara.ros2 import messages
from gym_mara.ros2.bags.bag import Bag, Recorder
from gym_mara.ros2.bags.logs import STATE_TYPE
from gym_mara.ros2.deploy_node import DIAGNOSTICS
from gym_mara.ros2.link import DISCOVERY, installed
from gym_mara.ros2.node import RosNode, needs_ros
from gym_mara.ros2.profiles import DESCRIPTION, Profile

with needs_ros("recording and replaying topics"):
    from ament_index_python.packages import get_package_share_path
    from rclpy.exceptions import InvalidTopicNameException
    from rclpy.qos import QoSProfile, ReliabilityPolicy

KINDS = (
    "diagnostic_msgs/msg/DiagnosticArray",
    "geometry_msgs/msg/PoseStamped",
    "sensor_msgs/msg/JointState",
    "std_msgs/msg/Float64MultiArray",
    "trajectory_msgs/msg/JointTrajectory",
)
"""What is recorded unless topics are named: states, commands, targets and diagnostics."""
PREFIX = "/replay"
_POLL = 0.1
"""How often new topics are looked for, s."""
PATIENCE = 10.0
"""How long the first message is waited for, s."""
ABSENT = 3.0
"""After which time the named topics that are not there yet are noted, s."""
_DEPTH = 1000
_LOOKED_AT = 1000
"""In how many states `lacking_joints` looks for joints."""
_Arrived = tuple[str, str, bytes, int]
"""The topic, the type, the serialised message and the time, ns."""


def message_class(kind: str) -> Any:
    """ROS's class of a type, such as "sensor_msgs/msg/JointState".

    Raises:
        GymMaraError: its package is not installed.
    """
    package, _, name = kind.split("/")
    try:
        return getattr(import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise GymMaraError(
            f"the messages {kind} are not installed here: source a ROS that has {package}, or leave this topic out"
        ) from error


def topics_of(profile: Profile) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The topics of an arm and of a policy that is deployed on it; and what is recorded otherwise than the profile says, or not."""
    own, notes = installed(profile)
    if own.commands == "action":
        notes += (f"the goals of the action {own.command_topic} are on no topic: not recorded",)
    return (*own.topics, own.of_policy("target"), DIAGNOSTICS), notes


def record(
    folder: Path,
    topics: Sequence[str] = (),
    duration: float | None = None,
    *,
    domain: int | None = None,
    absent: Callable[[list[str]], None] = lambda _: None,
) -> dict[str, int]:
    """Record topics until the duration is over or the process is interrupted; returns how many messages each has. A topic that
    was named and has not appeared is not in there.

    Args:
        folder: a new folder for the bag.
        topics: their names; all of `KINDS` if none is given. They may appear later.
        duration: from the first message on, but for a robot's description, s, which is waited for at most PATIENCE longer; None
            for no end.
        domain: the ROS domain; by default that of ROS_DOMAIN_ID, or 0.
        absent: is called once, after ABSENT, with the named topics that have not appeared yet, if there are some.

    Raises:
        GymMaraError: the folder exists, or cannot be written.
        MissingExtraError: ROS or `rosbags` is not installed.
    """
    arrived: SimpleQueue[_Arrived] = SimpleQueue()
    node = RosNode("gym_mara_record", domain=domain)
    try:
        with Recorder(folder) as recorder:
            subscribed: set[str] = set()
            recording: float | None = None
            end, look, note = math.inf, 0.0, time.monotonic() + ABSENT
            if duration is not None:
                end = time.monotonic() + duration + PATIENCE
            try:
                while (now := time.monotonic()) < end:
                    if now >= look:
                        _subscribe(node, recorder, topics, subscribed, arrived)
                        look = now + _POLL
                    if now >= note:
                        note = math.inf
                        if missing := [name for name in topics if name not in subscribed]:
                            absent(missing)
                    _drain(recorder, arrived, min(_POLL, end - now))
                    if duration is not None and recording is None and _moves(recorder):
                        recording = time.monotonic()
                        end = recording + duration
            except KeyboardInterrupt:
                pass  # which is how a recording ends
            _drain(recorder, arrived, 0.0)
            return {**{name: 0 for name in topics if name in subscribed}, **recorder.counts}
    finally:
        node.close()


def lacking_joints(folder: Path, topic: str, robot: RobotModel) -> list[str]:
    """The joints of a robot that none of the first states of a topic has; none if it has no sensor_msgs/JointState."""
    with Bag(folder) as bag:
        if bag.topics.get(topic) != STATE_TYPE:
            return []
        states = islice(bag.messages([topic]), _LOOKED_AT)
        there = {name for state in states for name in state.value.name}
    return [name for name in robot.joint_names if name not in there]


def _is_description(topic: str) -> bool:
    return topic.endswith(f"/{DESCRIPTION}")


def _moves(recorder: Recorder) -> bool:
    """Whether a message has come that does not come to everybody at once."""
    return not all(map(_is_description, recorder.counts))


def _drain(recorder: Recorder, arrived: SimpleQueue[_Arrived], patience: float) -> None:
    """Write the messages that have arrived; wait for the first one."""
    with suppress(Empty):
        recorder.add(*arrived.get(timeout=max(patience, 1e-3)))
        for _ in range(arrived.qsize()):
            recorder.add(*arrived.get_nowait())


def _subscribe(
    node: RosNode,
    recorder: Recorder,
    topics: Sequence[str],
    known: set[str],
    arrived: SimpleQueue[_Arrived],
) -> None:
    """Subscribe to the wanted topics that have appeared."""
    for topic, kinds in node.node.get_topic_names_and_types():
        wanted = topic in topics if topics else bool(set(kinds) & set(KINDS))
        if topic in known or not wanted or topic.startswith(f"{PREFIX}/"):
            continue
        known.add(topic)
        if len(kinds) != 1 or not (recorder.knows(kinds[0]) or _define(recorder, kinds[0])):
            raise GymMaraError(
                f"{topic} has messages {', '.join(kinds)}, which cannot be recorded: name other topics"
            )

        def put(data: bytes, topic: str = topic, kind: str = kinds[0]) -> None:
            arrived.put((topic, kind, data, time.time_ns()))

        quality = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        if _is_description(topic):  # it was published before, once
            quality = messages.LATCHED
        node.node.create_subscription(message_class(kinds[0]), topic, put, quality, raw=True)


def _define(recorder: Recorder, kind: str) -> bool:
    """Give a recorder the definition of a type that this ROS has, such as those of control_msgs; returns whether there is one."""
    package, folder, name = kind.split("/")
    try:
        definition = read_text(get_package_share_path(package) / folder / f"{name}.msg")
    except (LookupError, OSError, GymMaraError):
        return False
    return recorder.define(kind, definition)


def replay(path: Path, rate: float = 1.0, *, domain: int | None = None) -> dict[str, int]:
    """Publish the messages of a bag at the recorded pace, each on its topic under /replay; returns how many each has.

    No arm listens there: a replay is for looking at it.

    Args:
        path: the bag.
        rate: how many times as fast.
        domain: the ROS domain; by default that of ROS_DOMAIN_ID, or 0.

    Raises:
        DamagedFileError: the bag is missing or damaged.
        GymMaraError: it has no message that can be published, or a topic with a name that is none of ROS.
        MissingExtraError: ROS or `rosbags` is not installed.
    """
    with Bag(path) as bag:
        topics = [topic for topic, kind in bag.topics.items() if kind in KINDS]
        if not topics:
            raise GymMaraError(
                f"{str(path)!r} has nothing to replay; its topics are: {', '.join(bag.topics) or 'none'}"
            )
        counts = dict.fromkeys(topics, 0)
        node = RosNode("gym_mara_replay", domain=domain)
        try:
            publishers = {topic: _publisher(node, topic, bag.topics[topic]) for topic in topics}
            time.sleep(DISCOVERY)
            begin, first = time.monotonic(), None
            for connection, stamp, data in bag.raw(topics):
                first = stamp if first is None else first
                _sleep_until(begin + 1e-9 * (stamp - first) / rate)
                publishers[connection.topic].publish(bytes(data))
                counts[connection.topic] += 1
            time.sleep(_POLL)  # for the last messages to leave
        finally:
            node.close()
    return counts


def _publisher(node: RosNode, topic: str, kind: str) -> Any:
    try:
        return node.node.create_publisher(message_class(kind), PREFIX + topic, _DEPTH)
    except InvalidTopicNameException as error:
        reason = str(error).partition("\n")[0]
        raise GymMaraError(
            f"cannot replay the topic {short(topic, 80)} on {PREFIX}/…: {reason}"
        ) from None


def _sleep_until(instant: float) -> None:
    while (rest := instant - time.monotonic()) > 0.0:
        time.sleep(rest)
