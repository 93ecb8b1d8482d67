"""Records topics of ROS 2 as a bag, and plays a bag on topics of its own."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.ros2.bags import Bag, Recorder

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
"""How often new topics and the end are looked for, s."""
_DEPTH = 1000


@contextmanager
def _node(name: str) -> Iterator[tuple[Any, Callable[[float], None]]]:
    """A node in a context of its own, and what handles its messages for at most some seconds."""
    with needs("recording and replaying topics", "ros2", "ros-jazzy-rclpy"):
        from rclpy.context import Context
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.node import Node
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node(name, context=context, start_parameter_services=False, enable_rosout=False)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        try:
            yield node, lambda seconds: executor.spin_once(timeout_sec=seconds)
        finally:
            executor.shutdown()
            node.destroy_node()
    finally:
        context.try_shutdown()


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


def record(
    folder: Path,
    topics: Sequence[str] = (),
    duration: float | None = None,
    told: Callable[[Recorder], object] = lambda recorder: None,
) -> dict[str, int]:
    """Record topics until the duration is over or the process is interrupted; returns how many messages each has.

    Args:
        folder: a new folder for the bag.
        topics: their names; all of `KINDS` if none is given. They may appear later.
        duration: s; None for no end.
        told: called about every second.

    Raises:
        GymMaraError: the folder exists, or cannot be written.
        MissingExtraError: ROS or `rosbags` is not installed.
    """
    with _node("gym_mara_record") as (node, spin), Recorder(folder) as recorder:
        subscribed: set[str] = set()
        end = time.monotonic() + (duration if duration is not None else float("inf"))
        next_told = time.monotonic() + 1.0
        next_look = 0.0
        try:
            while (now := time.monotonic()) < end:
                if now >= next_look:
                    _subscribe(node, recorder, topics, subscribed)
                    next_look = now + _POLL
                spin(min(_POLL, end - now))
                if now >= next_told:
                    told(recorder)
                    next_told = now + 1.0
        except KeyboardInterrupt:
            pass  # which is how a recording ends
        return dict(recorder.counts)


def _subscribe(node: Any, recorder: Recorder, topics: Sequence[str], known: set[str]) -> None:
    """Subscribe to the wanted topics that have appeared."""
    from rclpy.qos import QoSProfile, ReliabilityPolicy

    for topic, kinds in node.get_topic_names_and_types():
        wanted = topic in topics if topics else bool(set(kinds) & set(KINDS))
        if topic in known or not wanted or topic.startswith(f"{PREFIX}/"):
            continue
        known.add(topic)
        if len(kinds) != 1 or not recorder.knows(kinds[0]):
            if topics:
                raise GymMaraError(
                    f"{topic} has messages {', '.join(kinds)}, which cannot be recorded: leave it out"
                )
            continue

        def write(data: bytes, topic: str = topic, kind: str = kinds[0]) -> None:
            recorder.add(topic, kind, data, time.time_ns())

        quality = QoSProfile(depth=_DEPTH, reliability=ReliabilityPolicy.BEST_EFFORT)
        node.create_subscription(message_class(kinds[0]), topic, write, quality, raw=True)


def replay(path: Path, rate: float = 1.0) -> dict[str, int]:
    """Publish the messages of a bag at the recorded pace, each on its topic under /replay; returns how many each has.

    No arm listens there: a replay is for looking at it.

    Args:
        path: the bag.
        rate: how many times as fast.

    Raises:
        DamagedFileError: the bag is missing or damaged.
        GymMaraError: it has no message that can be published.
        MissingExtraError: ROS or `rosbags` is not installed.
    """
    with Bag(path) as bag:
        topics = [topic for topic, kind in bag.topics.items() if kind in KINDS]
        if not topics:
            raise GymMaraError(
                f"{str(path)!r} has nothing to replay; its topics are: {', '.join(bag.topics) or 'none'}"
            )
        counts = dict.fromkeys(topics, 0)
        with _node("gym_mara_replay") as (node, spin):
            publishers = {
                topic: node.create_publisher(
                    message_class(bag.topics[topic]), PREFIX + topic, _DEPTH
                )
                for topic in topics
            }
            _wait(time.monotonic() + 0.5, spin)  # for those who listen to find the topics
            begin, first = time.monotonic(), None
            for connection, stamp, data in bag.raw(topics):
                first = stamp if first is None else first
                _wait(begin + 1e-9 * (stamp - first) / rate, spin)
                publishers[connection.topic].publish(bytes(data))
                counts[connection.topic] += 1
            _wait(time.monotonic() + 0.2, spin)  # for the last messages to leave
    return counts


def _wait(until: float, spin: Callable[[float], None]) -> None:
    while (rest := until - time.monotonic()) > 0.0:
        spin(min(rest, _POLL))
