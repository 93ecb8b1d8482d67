"""A program of ROS 2 that is not gym_mara's: reads joint states and commands an arm. It imports nothing of gym_mara.

Usage: python plain_peer.py {trajectory|forward|mara-2019|bad} OFFSET

It moves each joint from where it is by OFFSET, rad, in the given form, waits until the joint states show that, and prints
"there". With "bad" it sends commands that must be refused, and prints "rests" if the arm has not moved.
"""

import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import rclpy
from builtin_interfaces.msg import Duration
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

JOINTS = [f"motor{number}" for number in range(1, 7)]
NAN = math.nan
TOPICS = {
    "trajectory": ("/joint_trajectory_controller/joint_trajectory", JointTrajectory, 10),
    "forward": ("/forward_position_controller/commands", Float64MultiArray, 10),
    "mara-2019": ("/mara_controller/command", JointTrajectory, qos_profile_sensor_data),
}


def trajectory(
    names: list[str],
    positions: list[float],
    velocities: Sequence[float] = (),
    nanosec: int = 1_000_000,
) -> Any:
    duration = Duration(nanosec=nanosec)
    point = JointTrajectoryPoint(
        positions=positions, velocities=velocities, time_from_start=duration
    )
    return JointTrajectory(joint_names=names, points=[point])


def command(form: str, goal: list[float]) -> Any:
    if form == "forward":
        return Float64MultiArray(data=goal)
    if form == "mara-2019":
        return trajectory(JOINTS, goal, [0.5] * 6)
    return trajectory(JOINTS[::-1], goal[::-1], nanosec=500_000_000)


def bad_commands(here: list[float]) -> Iterator[tuple[str, Any]]:
    """Commands that must be refused, by the form."""
    moved = [q + 0.5 for q in here]
    yield "forward", Float64MultiArray(data=[NAN, *moved[1:]])
    yield "forward", Float64MultiArray(data=moved[:5])
    for form in ("trajectory", "mara-2019"):
        yield form, trajectory(JOINTS, [NAN, *moved[1:]])
        yield form, trajectory(JOINTS[:5], moved[:5])
        yield form, trajectory([f"ur_{name}" for name in JOINTS], moved)
        yield form, trajectory(JOINTS, moved, [NAN] * 6)
        yield form, trajectory(JOINTS, moved[:5])


class Peer:
    def __init__(self) -> None:
        context = Context()
        rclpy.init(args=[], context=context)
        self.node = Node("plain_peer", context=context)
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.state: list[float] = []
        self.node.create_subscription(
            JointState, "/joint_states", self.on_state, qos_profile_sensor_data
        )
        self.publishers = {
            form: self.node.create_publisher(kind, topic, qos)
            for form, (topic, kind, qos) in TOPICS.items()
        }

    def on_state(self, message: Any) -> None:
        places = dict(zip(message.name, message.position, strict=True))
        self.state = [places[name] for name in JOINTS]

    def wait(self, condition: Callable[[], object], seconds: float) -> None:
        end = time.monotonic() + seconds
        while not condition():
            if time.monotonic() > end:
                sys.exit(f"not in time; the state is {self.state}")
            self.executor.spin_once(timeout_sec=0.05)

    def is_at(self, goal: list[float]) -> bool:
        return max(abs(q - g) for q, g in zip(self.state, goal, strict=True)) < 0.01


def main() -> None:
    form, offset = sys.argv[1], float(sys.argv[2])
    peer = Peer()
    used = TOPICS if form == "bad" else [form]
    peer.wait(
        lambda: peer.state and all(peer.publishers[name].get_subscription_count() for name in used),
        10.0,
    )
    here = list(peer.state)
    if form == "bad":
        for name, message in bad_commands(here):
            peer.publishers[name].publish(message)
        end = time.monotonic() + 1.0
        peer.wait(lambda: time.monotonic() > end, 2.0)
        print("rests" if peer.is_at(here) else f"moved from {here} to {peer.state}")
        return
    goal = [q + offset for q in here]
    peer.publishers[form].publish(command(form, goal))
    peer.wait(lambda: peer.is_at(goal), 10.0)
    print("there")


if __name__ == "__main__":
    main()
