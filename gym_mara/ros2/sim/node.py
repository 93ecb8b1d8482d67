"""`gym-mara ros2 sim`: a simulated arm behind the topics of ros2_control, in real time."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from typing import Any

from gym_mara.errors import GymMaraError
from gym_mara.ros2 import graph, messages
from gym_mara.ros2.arm import Clock, WallClock
from gym_mara.ros2.driver import spare_what_is_loaded
from gym_mara.ros2.node import RosNode, needs_ros
from gym_mara.ros2.sim.arm import Pace, SimulatedArm
from gym_mara.state import Contact, SimState

with needs_ros("a simulated arm"):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from rosgraph_msgs.msg import Clock as ClockMessage
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray, String
    from std_srvs.srv import Trigger
    from trajectory_msgs.msg import JointTrajectory

DISCOVERY = 0.5
"""How long other nodes take to be discovered, s."""
NODE = "gym_mara_sim"
"""The name of the node."""
JOINT_STATES = "/joint_states"
TRAJECTORY = "/joint_trajectory_controller/joint_trajectory"
ACTION = "/joint_trajectory_controller/follow_joint_trajectory"
FORWARD = "/forward_position_controller/commands"
MARA_2019 = "/mara_controller/command"
MARA_2019_STATE = "/mara_controller/state"
_RESET_TIME = 1.0
"""How long the service waits for the reset, s."""


class SimNode:
    """A simulated arm as a ROS node: joint states, the robot's description, contacts, and the three forms of commands at once.

    A command that is not complete and finite, or that is for other joints, is refused: it is logged, and counted in
    `refused`, and the arm goes on as before.

    Args:
        arm: the arm.
        clock: whether to publish /clock, the simulated time, which is then the time of the stamps too.
        domain: the ROS domain; by default that of ROS_DOMAIN_ID, or 0.
        pace: the clock that sets the pace.
        on_tick: is called with the state after each tick, such as for a picture.

    Raises:
        GymMaraError: as in `RosNode`.
    """

    def __init__(
        self,
        arm: SimulatedArm,
        *,
        clock: bool = False,
        domain: int | None = None,
        pace: Clock | None = None,
        on_tick: Callable[[SimState], object] | None = None,
    ) -> None:
        self.arm = arm
        self.refused = 0
        """How many commands were refused."""
        self.pace = Pace(arm.period, pace or WallClock())
        self._names = list(arm.robot.joint_names)
        self._touching = False
        self._on_tick = on_tick
        self.ros = RosNode(NODE, domain=domain)
        node = self.ros.node
        self._clock = node.create_publisher(ClockMessage, "/clock", 10) if clock else None
        self._states = node.create_publisher(JointState, JOINT_STATES, messages.RELIABLE)
        self._contacts = node.create_publisher(DiagnosticArray, "~/contacts", messages.RELIABLE)
        self._description = node.create_publisher(String, "/robot_description", messages.LATCHED)
        self._description.publish(String(data=arm.robot.xml))
        self._subscriptions = [
            node.create_subscription(kind, topic, self._obey(command), qos)
            for kind, topic, command, qos in (
                (JointTrajectory, TRAJECTORY, self._follow, messages.RELIABLE),
                (JointTrajectory, MARA_2019, self._move_servos, messages.SENSOR_DATA),
                (Float64MultiArray, FORWARD, self._move_to, messages.RELIABLE),
            )
        ]
        self._service = node.create_service(Trigger, "~/reset", self._reset)
        self._actions: Any = None
        self._mara_states: Any = None
        if messages.control_msgs_installed():
            from gym_mara.ros2.sim.follow_action import FollowAction

            self._actions = FollowAction(node, ACTION, arm, self.delay_of)
            kind = messages.controller_state_type()
            self._mara_states = node.create_publisher(kind, MARA_2019_STATE, messages.SENSOR_DATA)

    def check_alone(self) -> None:
        """Check that no other arm has the same topics, after the time that it takes to discover others.

        Raises:
            GymMaraError: another one has.
        """
        time.sleep(DISCOVERY)
        node = self.ros.node
        if rivals := graph.others(graph.publishers(node, JOINT_STATES), node, 1):
            raise GymMaraError(
                f"{graph.names(rivals)} publishes {JOINT_STATES} too, in the ROS domain {self.ros.domain}: end it, or choose another "
                "--domain, because commands would move both arms"
            )

    @property
    def summary(self) -> str:
        """What the node offers, in a line."""
        arm = self.arm
        forms = [TRAJECTORY, FORWARD, MARA_2019, *([ACTION] if self._actions else [])]
        return (
            f"{arm.robot.name} at {1.0 / arm.period:.6g} Hz in the ROS domain {self.ros.domain}: states on {JOINT_STATES}, commands on "
            f"{', '.join(forms)}"
        )

    def run(self, seconds: float | None = None) -> None:
        """Move the arm in real time and publish its states.

        Args:
            seconds: for how long, s of simulated time; None for no end.
        """
        end = None if seconds is None else self.arm.time + seconds
        spare_what_is_loaded()
        while end is None or self.arm.time < end:
            self.pace.wait()
            self.tick()

    def tick(self) -> None:
        """Move the arm for a period and publish its state."""
        state = self.arm.tick()
        now = self.now()
        if self._clock is not None:
            self._clock.publish(ClockMessage(clock=messages.stamp(now)))
        self._states.publish(self._joint_state(state, now))
        self._publish_contacts(state, now)
        if self._mara_states is not None:
            self._mara_states.publish(self._controller_state(state, now))
        if self._actions is not None:
            self._actions.update()
        if self._on_tick is not None:
            self._on_tick(state)

    def now(self) -> float:
        """The time of the stamps, s: simulated time where /clock is published."""
        return self.ros.now() if self._clock is None else self.arm.time

    def delay_of(self, header: Any) -> float:
        """From now to the stamp of a command, s; zero if it has none."""
        stamp = messages.seconds(header.stamp)
        return stamp - self.now() if stamp else 0.0

    def close(self) -> None:
        """End the node and the backend."""
        self.ros.close()
        self.arm.backend.close()
        gc.unfreeze()

    # The methods from here on run in the thread of the node.

    def _obey(self, command: Callable[[Any], object]) -> Callable[[Any], None]:
        """A callback that gives messages to a command and logs the refusals."""

        def callback(message: Any) -> None:
            try:
                command(message)
            except GymMaraError as error:
                self.refused += 1
                self.ros.node.get_logger().warning(f"refused: {error}", throttle_duration_sec=1.0)

        return callback

    def _follow(self, message: Any) -> None:
        self.arm.follow(
            message.joint_names, messages.points(message), self.delay_of(message.header)
        )

    def _move_servos(self, message: Any) -> None:
        self.arm.move_servos(message.joint_names, messages.points(message))

    def _move_to(self, message: Any) -> None:
        self.arm.move_to(message.data)

    def _reset(self, _: Any, response: Any) -> Any:
        response.success = self.arm.reset().wait(_RESET_TIME)
        response.message = "at home" if response.success else "the simulation does not advance"
        return response

    # The messages.

    def _joint_state(self, state: SimState, now: float) -> Any:
        message = JointState(name=self._names, position=state.q[0].tolist())
        message.header.stamp = messages.stamp(now)
        message.velocity = state.qd[0].tolist()
        if state.torque is not None:
            message.effort = state.torque[0].tolist()
        return message

    def _controller_state(self, state: SimState, now: float) -> Any:
        message = messages.controller_state_type()(joint_names=self._names)
        message.header.stamp = messages.stamp(now)
        feedback = message.feedback if hasattr(message, "feedback") else message.actual
        feedback.positions, feedback.velocities = state.q[0].tolist(), state.qd[0].tolist()
        return message

    def _publish_contacts(self, state: SimState, now: float) -> None:
        """Publish the contacts of a tick with some, and once that there are none any more."""
        touching = bool(state.collided[0])
        contacts = () if state.contacts is None else state.contacts[0]
        if touching or contacts or self._touching:
            message = DiagnosticArray(status=[_status(contact) for contact in contacts])
            message.header.stamp = messages.stamp(now)
            if touching and not contacts:  # the engine does not say which
                message.status = [_status(Contact(("", ""), 0.0))]
            self._contacts.publish(message)
        self._touching = touching or bool(contacts)


def _status(contact: Contact) -> Any:
    """A contact as a diagnostic status."""
    first, second = contact.links
    values = {"link1": first, "link2": second, "depth": f"{contact.depth:.9g}"}
    return DiagnosticStatus(
        level=DiagnosticStatus.WARN,
        name="contact",
        message=f"{first} touches {second}" if first else "links touch",
        hardware_id=NODE,
        values=[KeyValue(key=key, value=value) for key, value in values.items()],
    )
