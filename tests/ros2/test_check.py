"""The check of an arm: every line that can be wrong, with arms that are."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

pytest.importorskip("rclpy")

from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from gym_mara.deploy import OnnxPolicy
from gym_mara.pretrained import pretrained_file
from gym_mara.robot import RobotModel
from gym_mara.ros2 import messages
from gym_mara.ros2.check import Report, check
from gym_mara.ros2.profiles import make_profile
from tests.helpers import robot_model
from tests.ros2.peers import Peer

NAMES = [f"motor{number}" for number in range(1, 7)]
PROFILE = make_profile()
TIMES = {"rate", "jitter", "age of states", "transport", "states"}
"""What may be wrong on a machine that is too busy, or is seen only after a second of silence."""


@contextmanager
def arm(
    *,
    rate: float = 50.0,
    names: list[str] = NAMES,
    position: float = 0.1,
    speed: float = 1.0,
    offset: float = 0.0,
    listens: bool = True,
    rival: bool = False,
    gripper: bool = False,
) -> Iterator[None]:
    """An arm that publishes states with a clock of some speed, times real time, and an offset, s."""
    peer, ending = Peer("arm"), threading.Event()
    states = peer.publisher(JointState, "/joint_states")
    if listens:
        peer.heard(JointTrajectory, PROFILE.command_topic)
    if rival:
        peer.publisher(JointTrajectory, PROFILE.command_topic)
    began = peer.ros.now()

    def publish() -> None:
        while not ending.wait(1.0 / rate):
            message = JointState(name=names, position=[position] * len(names))
            now = began + offset + speed * (peer.ros.now() - began)
            message.header.stamp = messages.stamp(now)
            states.publish(message)
            if gripper:
                states.publish(JointState(header=message.header, name=["finger"], position=[0.0]))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()
        peer.close()


def checked(robot: RobotModel, about: Any = None, seconds: float = 0.5) -> Report:
    return check(robot, PROFILE, about, seconds=seconds)


def wrong(report: Report) -> dict[str, str]:
    """What is wrong, with what was found and what to do."""
    assert report.ok == all(line.ok for line in report.lines)
    assert all(line.remedy for line in report.lines if not line.ok)
    return {line.what: f"{line.found}: {line.remedy}" for line in report.lines if not line.ok}


def test_nothing_is_wrong_with_a_good_arm(ros_domain: int, mara: RobotModel) -> None:
    about = OnnxPolicy(pretrained_file("MARAReach-v0")).about
    with arm(names=[*NAMES[::-1], "gripper"], rate=100.0):
        report = checked(mara, about)
    assert set(wrong(report)) <= TIMES
    texts = {line.what: line.found for line in report.lines}
    assert texts["joints"] == "all 6, by name, in another order, and 1 others, which are ignored"
    assert "/arm (reliable, volatile)" in texts["states"]
    assert report.figures["latency"][0] >= about.control_period


def test_the_states_of_a_gripper_on_the_same_topic_do_not_count(
    ros_domain: int, mara: RobotModel
) -> None:
    with arm(gripper=True):
        report = checked(mara)
    assert set(wrong(report)) <= TIMES
    assert report.figures["rate"] < 60.0
    texts = {line.what: line.found for line in report.lines}
    assert texts["joints"] == "all 6, by name, in the order of the robot"


def test_a_controller_of_positions_that_does_not_tell_its_joints_is_noted(
    ros_domain: int, mara: RobotModel, peer: Peer
) -> None:
    forward = make_profile("forward")
    peer.heard(Float64MultiArray, forward.command_topic)
    with arm():
        report = check(mara, forward, seconds=0.5)
    (note,) = (line.found for line in report.lines if line.what == "note")
    assert "/peer does not tell its joints: compare them, and their order, with motor1" in note


CASES: list[tuple[dict[str, Any], set[str], str]] = [
    ({"names": [f"ur_{name}" for name in NAMES]}, {"states", "joints"}, "prefix 'ur_'"),
    ({"rate": 15.0, "speed": 0.92}, {"rate", "clock"}, "at least 20 are needed"),
    ({"speed": 0.5, "rival": True}, {"clock", "commands", "joints"}, "times real time"),
    ({"rate": 4.0}, {"rate", "jitter"}, "states a second"),
    ({"names": NAMES[:4]}, {"states", "joints"}, "motor5, motor6"),
    ({"position": 2.4}, {"limits"}, "beyond its own"),
    ({"position": 90.0}, {"states", "joints"}, "has it the unit rad"),
    ({"speed": 0.0}, {"joints", "clock"}, "stands still"),
    ({"offset": 5.0}, {"clock"}, "ahead of"),
    ({"offset": -5.0}, {"clock"}, "behind"),
    ({"listens": False}, {"commands"}, "nobody listens"),
    ({"rival": True}, {"commands"}, "two commanders"),
]


@pytest.mark.parametrize(
    ("options", "what", "words"),
    [*CASES[:2], *(pytest.param(*case, marks=pytest.mark.slow) for case in CASES[2:])],
)
def test_what_is_wrong_is_found(
    options: dict[str, Any], what: set[str], words: str, ros_domain: int, mara: RobotModel
) -> None:
    with arm(**options):
        found = wrong(checked(mara, seconds=2.0 if "rate" in what else 0.5))
    assert what <= set(found) <= what | TIMES
    assert words in " ".join(found.values())


@pytest.mark.slow
def test_a_policy_of_another_robot_is_found(ros_domain: int) -> None:
    about = OnnxPolicy(pretrained_file("MARAReach-v0")).about
    with arm():
        found = wrong(check(robot_model("ur5"), PROFILE, about, seconds=0.3))
    assert {"policy's joints", "policy's robot", "joints"} <= set(found)


@pytest.mark.slow
def test_nobody_is_there_and_that_takes_a_few_seconds(ros_domain: int, mara: RobotModel) -> None:
    before = time.monotonic()
    report = checked(mara)
    assert set(wrong(report)) == {"states", "commands"}
    assert report.figures["latency"] is None
    assert time.monotonic() - before < 8.0
