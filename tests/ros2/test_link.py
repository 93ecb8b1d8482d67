"""RosLink against plain publishers and subscribers, in a domain of its own."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import GetParameters
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from trajectory_msgs.msg import JointTrajectory

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2 import joints, messages
from gym_mara.ros2.arm import Setpoint
from gym_mara.ros2.link import UNREADABLE, RosLink
from gym_mara.ros2.profiles import make_profile
from tests.ros2.peers import Peer, eventually

Q = [0.1, -0.2, 0.3, -0.4, 0.5, -0.6]
NAMES = [f"motor{number}" for number in range(1, 7)]
SETPOINT = Setpoint(np.array(Q), np.array(Q) / 2.0, np.zeros(6))
COMMANDS = make_profile().command_topic


@pytest.fixture
def links(ros_domain: int) -> Iterator[Callable[..., RosLink]]:
    made: list[RosLink] = []

    def make(robot: RobotModel, *arguments: Any, **options: Any) -> RosLink:
        made.append(RosLink(robot, *arguments, **options))
        return made[-1]

    yield make
    for link in made:
        link.close()


def state(stamp: float, **values: Any) -> Any:
    message = JointState(**{"name": NAMES[::-1], "position": Q[::-1], **values})
    message.header.stamp = messages.stamp(stamp)
    return message


class Arm:
    """Publishes a state whenever it is asked for, with a stamp that advances, so fast that none is late."""

    def __init__(self, peer: Peer, topic: str = "/joint_states") -> None:
        self.publisher = peer.publisher(JointState, topic)
        self.time = 100.0

    def publish(self, advance: float = 0.5, **values: Any) -> bool:
        self.time += advance
        self.publisher.publish(state(self.time, **values))
        return True


def test_states_arrive_in_the_order_of_the_robot(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link, arm = links(mara), Arm(peer)
    assert link.state is None
    got = eventually(lambda: arm.publish() and link.state)
    assert got.q.tolist() == Q
    assert got.stamp >= 100.0
    assert got.received > 0.0
    assert got.effort is None


def test_refusals_are_counted_and_the_last_good_state_stays(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link, arm = links(mara), Arm(peer)
    good = eventually(lambda: arm.publish() and link.state)
    for values in (
        {"position": [math.nan] * 6},
        {"name": NAMES[:2], "position": Q[:2]},
        {"name": ["x"], "position": [0.0]},
        {"position": Q[:5]},
    ):
        arm.publish(**values)
    eventually(lambda: sum(link.refused.values()) == 4)
    assert link.refused == dict.fromkeys(
        [joints.NOT_FINITE, joints.MISSING, joints.UNKNOWN, joints.LENGTHS], 1
    )
    now = link.state
    assert now is not None
    assert now.q.tolist() == good.q.tolist()
    arm.publish(position=[0.0] * 6)
    eventually(lambda: link.state is not None and not link.state.q.any())


def test_an_exception_in_a_callback_is_a_refusal_and_ends_nothing(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    link, arm = links(mara), Arm(peer)
    eventually(lambda: arm.publish() and link.state)
    with monkeypatch.context() as patched:
        patched.setattr(link, "parse", lambda message: 1 / 0)
        eventually(lambda: arm.publish() and link.refused.get(UNREADABLE, 0) >= 2)
    arm.publish(position=[0.0] * 6)
    eventually(lambda: link.state is not None and not link.state.q.any())


def test_a_state_is_as_old_as_the_middleware_says(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link, arm = links(mara), Arm(peer)
    held_up = threading.Event()
    link.node.node.create_subscription(String, "/hold_up", lambda _: held_up.wait(2.0), 10)
    eventually(lambda: arm.publish() and link.state is not None)
    hold_up = peer.publisher(String, "/hold_up")
    eventually(lambda: hold_up.get_subscription_count())
    hold_up.publish(String())
    time.sleep(0.2)
    before = link.state
    arm.publish(position=[0.1] * 6)
    time.sleep(0.5)
    held_up.set()
    late = eventually(lambda: link.state is not before and link.state)
    assert time.monotonic() - late.received > 0.4, "the thread was held up for so long"


@pytest.mark.parametrize("name", ["trajectory", "mara-2019"])
def test_trajectories_are_sent(
    name: str, links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link = links(mara, name)
    heard = peer.heard(JointTrajectory, link.profile.command_topic, link._qos)
    eventually(lambda: not link.command_problems())

    def answer() -> list[Any]:
        link.send(SETPOINT, 0.02)  # again and again, because what is sent best effort may be lost
        return heard

    message = eventually(answer)[0]
    (point,) = message.points
    old = name == "mara-2019"
    assert message.joint_names == NAMES
    assert point.positions.tolist() == Q
    assert point.velocities.tolist() == ([0.5] * 6 if old else [])
    assert messages.seconds(point.time_from_start) == pytest.approx(0.001 if old else 0.04)
    assert messages.seconds(message.header.stamp) == 0.0  # so it starts when it arrives
    assert bool(link.notes) == (old and not messages.control_msgs_installed())


def test_positions_are_sent(links: Callable[..., RosLink], peer: Peer, mara: RobotModel) -> None:
    link = links(mara, "forward", namespace="left")
    heard = peer.heard(Float64MultiArray, "/left/forward_position_controller/commands")
    eventually(lambda: not link.command_problems())
    link.send(SETPOINT, 0.02)
    (message,) = eventually(lambda: heard)
    assert message.data.tolist() == Q


def test_what_is_not_finite_is_never_sent(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link = links(mara)
    heard = peer.heard(JointTrajectory, COMMANDS)
    eventually(lambda: not link.command_problems())
    for bad in (math.nan, math.inf):
        wrong = np.array([*Q[:5], bad])
        for setpoint in (SETPOINT._replace(q=wrong), SETPOINT._replace(qd=wrong)):
            with pytest.raises(GymMaraError, match="nothing was sent"):
                link.send(setpoint, 0.02)
    with pytest.raises(GymMaraError, match="6 finite"):
        link.send(SETPOINT._replace(q=np.zeros(5)), 0.02)
    link.send(SETPOINT, 0.02)
    eventually(lambda: heard)
    assert len(heard) == 1


def test_a_closed_link_sends_nothing(links: Callable[..., RosLink], mara: RobotModel) -> None:
    for link in (links(mara), links(mara, commands=False)):
        if link._publisher is not None:
            link.close()
            link.close()
        with pytest.raises(GymMaraError, match="closed, or was made"):
            link.send(SETPOINT, 0.02)


def test_an_arm_that_is_not_there(links: Callable[..., RosLink], mara: RobotModel) -> None:
    link = links(mara)
    with pytest.raises(GymMaraError, match=r"nobody publishes /joint_states.*nobody listens"):
        link.wait(0.1)


def test_what_is_wrong_is_found_and_goes_away(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link, arm = links(mara), Arm(peer)
    peer.heard(JointTrajectory, COMMANDS)
    rival = peer.publisher(JointTrajectory, COMMANDS)
    wrong = f"/peer publishes {COMMANDS} too: end it, because two commanders fight for the arm"
    eventually(lambda: arm.publish() and link.problems() == [wrong])
    peer.ros.node.destroy_publisher(rival)
    eventually(lambda: arm.publish() and not link.problems())
    link.wait(5.0)


def test_a_clock_that_stands_still(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link, arm = links(mara), Arm(peer)
    eventually(lambda: arm.publish(0.0) and "stands still" in " ".join(link.problems()))


def test_states_that_cannot_be_used_are_explained(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link, arm = links(mara), Arm(peer)
    names = [f"ur_{name}" for name in NAMES]
    eventually(lambda: arm.publish(name=names) and "prefix 'ur_'" in " ".join(link.problems()))


def test_topics_of_other_types_are_found(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link = links(mara)
    peer.publisher(String, "/joint_states")
    peer.heard(Float64MultiArray, COMMANDS)
    wanted = (
        "std_msgs/msg/String, and sensor_msgs/msg/JointState is needed",
        "std_msgs/msg/Float64MultiArray, and trajectory_msgs/msg/JointTrajectory would be sent",
    )
    eventually(lambda: all(text in "; ".join(link.problems()) for text in wanted))


def test_a_controller_with_another_order_of_joints_is_found(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    order = NAMES[::-1]

    def tell(request: Any, response: Any) -> Any:
        assert request.names == ["joints"]
        response.values = [ParameterValue(type=9, string_array_value=order)]
        return response

    peer.ros.node.create_service(GetParameters, "/peer/get_parameters", tell)
    peer.heard(Float64MultiArray, "/forward_position_controller/commands")
    link = links(mara, "forward")
    eventually(lambda: "/peer has the joints motor6, motor5" in "; ".join(link.command_problems()))
    order.reverse()
    link.close()
    other = links(mara, "forward")
    eventually(lambda: not other.command_problems() and other.orders)


def test_a_quality_of_service_that_does_not_fit_is_found(
    links: Callable[..., RosLink], peer: Peer, mara: RobotModel
) -> None:
    link = links(mara)
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    peer.heard(JointTrajectory, COMMANDS, latched)
    eventually(lambda: any("do not reach /peer" in p for p in link.problems()))


def test_a_node_can_be_shared(peer: Peer, mara: RobotModel, ros_domain: int) -> None:
    arm = Arm(peer)
    link = RosLink(mara, node=peer.ros)
    eventually(lambda: arm.publish() and link.state)
    link.close()
    heard = peer.heard(JointState, "/joint_states")
    eventually(lambda: arm.publish() and heard)  # the node lives on


def test_the_action_needs_control_msgs(mara: RobotModel) -> None:
    if messages.control_msgs_installed():
        pytest.skip("control_msgs is installed")
    with pytest.raises(GymMaraError, match="the profile 'trajectory'"):
        RosLink(mara, "action")


def test_a_profile_of_other_joints_and_topics_given_twice_are_refused(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="make_profile"):
        RosLink(mara, make_profile(), controller="other")
