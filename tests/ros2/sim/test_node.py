"""The simulated arm's node: what it publishes, and what it obeys, in one process with its peers."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from gym_mara.backends import make_backend
from gym_mara.robot import RobotModel
from gym_mara.ros2 import messages
from gym_mara.ros2.arm import Setpoint
from gym_mara.ros2.link import RosLink
from gym_mara.ros2.sim import node as sim
from gym_mara.ros2.sim.arm import SimulatedArm
from gym_mara.ros2.sim.node import SimNode
from tests.helpers import robot_model
from tests.ros2.peers import Peer, eventually

NAMES = [f"motor{number}" for number in range(1, 7)]


@contextmanager
def running(
    backend: str = "pinocchio", clock: bool = False, **options: object
) -> Iterator[SimNode]:
    """A simulated arm that is ticked by a thread of its own."""
    servo = {"servo_gain": 20.0, "control_period": 0.01, **options}
    engine = make_backend(backend, robot_model("mara"), 1, servo)
    node = SimNode(SimulatedArm(engine), clock=clock)
    ending = threading.Event()

    def tick() -> None:
        while not ending.is_set():
            node.run(node.arm.period)

    thread = threading.Thread(target=tick)
    thread.start()
    try:
        yield node
    finally:
        ending.set()
        thread.join(10.0)
        node.close()


@pytest.fixture
def node(ros_domain: int) -> Iterator[SimNode]:
    with running() as made:
        yield made


def is_at(node: SimNode, goal: Any) -> Callable[[], bool]:
    return lambda: bool(np.allclose(node.arm.state.q[0], goal, atol=2e-3))


def is_reported(link: RosLink, goal: Any) -> Callable[[], bool]:
    return lambda: link.state is not None and bool(np.allclose(link.state.q, goal, atol=2e-3))


def _refused(node: SimNode, count: int) -> bool:
    return node.refused == count


def trajectory(goal: Any, seconds: float = 0.2, names: list[str] = NAMES) -> Any:
    return messages.trajectory(names, np.asarray(goal, np.float64), None, seconds)


def servos(goal: Any) -> Any:
    """A command in the form of 2019."""
    return messages.trajectory(NAMES, np.asarray(goal, np.float64), np.full(6, 0.5), 0.001)


def send(publisher: Any, message: Any) -> None:
    """Publish once, when somebody listens."""
    eventually(lambda: publisher.get_subscription_count() > 0)
    publisher.publish(message)


def test_it_reports_the_arm(node: SimNode, peer: Peer, mara: RobotModel) -> None:
    states = peer.heard(JointState, sim.JOINT_STATES)
    descriptions = peer.heard(String, "/robot_description", messages.LATCHED)
    eventually(lambda: len(states) > 10 and descriptions)
    assert states[-1].name == NAMES
    assert states[-1].position.tolist() == pytest.approx(mara.home.tolist(), abs=1e-6)
    assert len(states[-1].velocity) == 6
    stamps = [messages.seconds(state.header.stamp) for state in states]
    assert np.all(np.diff(stamps) > 0.0)
    assert abs(stamps[-1] - node.ros.now()) < 1.0
    assert descriptions[0].data == mara.xml


def test_it_obeys_all_forms_of_commands(node: SimNode, peer: Peer, mara: RobotModel) -> None:
    commands: list[tuple[Any, Callable[[Any], Any]]] = [
        (peer.publisher(JointTrajectory, sim.TRAJECTORY), trajectory),
        (peer.publisher(JointTrajectory, sim.MARA_2019, messages.SENSOR_DATA), servos),
        (
            peer.publisher(Float64MultiArray, sim.FORWARD),
            messages.positions,
        ),
    ]
    for number, (publisher, message) in enumerate(commands, start=1):
        goal = mara.home + 0.05 * number
        send(publisher, message(goal))
        eventually(is_at(node, goal))
    assert node.refused == 0
    began, goal = node.arm.time, node.arm.state.q[0] + 0.3
    commands[1][0].publish(servos(goal))
    eventually(is_at(node, goal))
    assert node.arm.time - began > 0.3 / 0.5, "the velocity of the point is its speed"


def test_bad_commands_are_refused_and_logged(
    node: SimNode, peer: Peer, mara: RobotModel, capfd: pytest.CaptureFixture[str]
) -> None:
    points = peer.publisher(JointTrajectory, sim.TRAJECTORY)
    positions = peer.publisher(Float64MultiArray, sim.FORWARD)
    bad = [math.nan, *mara.home[1:]]
    for publisher, message in (
        (points, trajectory(bad)),
        (points, trajectory(mara.home[:5], names=NAMES[:5])),
        (points, trajectory(mara.home, names=[f"ur_{name}" for name in NAMES])),
        (points, JointTrajectory(joint_names=NAMES, points=[JointTrajectoryPoint()])),
        (positions, Float64MultiArray(data=bad)),
        (positions, Float64MultiArray(data=[0.0] * 5)),
        (positions, Float64MultiArray()),
    ):
        before = node.refused
        send(publisher, message)
        eventually(partial(_refused, node, before + 1))
    assert is_at(node, mara.home)()
    assert "refused: " in capfd.readouterr().err


def test_an_empty_trajectory_stops_it(node: SimNode, peer: Peer, mara: RobotModel) -> None:
    points = peer.publisher(JointTrajectory, sim.TRAJECTORY)
    send(points, trajectory(mara.home + 1.0, 5.0))
    eventually(lambda: node.arm.state.q[0, 0] > mara.home[0] + 0.1)
    points.publish(JointTrajectory())
    eventually(lambda: not node.arm.state.qd.any())
    assert node.arm.state.q[0, 0] < mara.home[0] + 0.9


def test_a_stamp_in_the_header_is_the_start(node: SimNode, peer: Peer, mara: RobotModel) -> None:
    points = peer.publisher(JointTrajectory, sim.TRAJECTORY)
    old = trajectory(mara.home + 0.1)
    old.header.stamp = messages.stamp(node.ros.now() - 10.0)
    send(points, old)
    eventually(lambda: node.refused == 1)
    recent = trajectory(mara.home + 0.1)
    recent.header.stamp = messages.stamp(node.ros.now())
    send(points, recent)
    eventually(is_at(node, mara.home + 0.1))


def test_the_service_puts_it_at_home(node: SimNode, peer: Peer, mara: RobotModel) -> None:
    node.arm.move_to((mara.home + 0.3).tolist())
    eventually(is_at(node, mara.home + 0.3))
    response = peer.call(Trigger, "/gym_mara_sim/reset")
    assert response.success
    assert is_at(node, mara.home)()


def test_the_clock_is_the_simulated_time(peer: Peer, ros_domain: int) -> None:
    with running(clock=True) as node:
        clocks, states = peer.heard(Clock, "/clock"), peer.heard(JointState, sim.JOINT_STATES)
        eventually(lambda: len(clocks) > 5 and len(states) > 5)
        latest = node.arm.time + 1e-9
        assert 0.0 < messages.seconds(clocks[-1].clock) <= latest
        assert messages.seconds(states[-1].header.stamp) <= latest


def test_contacts_are_published_and_their_end(
    peer: Peer, mara: RobotModel, ros_domain: int
) -> None:
    with running("mujoco") as node:
        heard = peer.heard(DiagnosticArray, "/gym_mara_sim/contacts")
        down = mara.home.copy()
        down[1] = mara.upper[1]  # into the table
        node.arm.move_to(down.tolist())
        first = eventually(lambda: heard)[0].status[0]
        values = {pair.key: pair.value for pair in first.values}
        assert set(values) == {"link1", "link2", "depth"}
        assert first.message == f"{values['link1']} touches {values['link2']}"
        assert float(values["depth"]) >= 0.0
        node.arm.reset()
        eventually(lambda: not heard[-1].status)


@pytest.mark.slow
def test_an_engine_without_contacts_reports_that_links_touch(
    node: SimNode, peer: Peer, mara: RobotModel
) -> None:
    heard = peer.heard(DiagnosticArray, "/gym_mara_sim/contacts")
    down = mara.home.copy()
    down[1] = mara.upper[1]
    node.arm.move_to(down.tolist())
    eventually(lambda: heard and heard[-1].status and heard[-1].status[0].message == "links touch")


@pytest.mark.slow
def test_a_link_moves_it(node: SimNode, mara: RobotModel) -> None:
    """The two halves of the package speak to each other, in every form that needs no control_msgs."""
    for number, profile in enumerate(("trajectory", "forward", "mara-2019"), start=1):
        link = RosLink(mara, profile)
        try:
            link.wait(8.0)
            goal = mara.home + 0.05 * number
            zeros = np.zeros(6)
            link.send(Setpoint(goal, zeros, zeros), 0.02)
            eventually(is_reported(link, goal))
            assert not link.refused
        finally:
            link.close()
