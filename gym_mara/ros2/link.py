"""RosLink: the connection to one arm by ROS's topics."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2 import graph, messages
from gym_mara.ros2.arm import ArmState, Setpoint
from gym_mara.ros2.joints import OUT_OF_ORDER, REPEATED, JointMap
from gym_mara.ros2.node import RosNode, needs_ros
from gym_mara.ros2.profiles import Profile, make_profile

with needs_ros("the connection to an arm"):
    from rclpy.action import ActionClient
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray
    from trajectory_msgs.msg import JointTrajectory

GOAL = "goal not accepted"
"""The reason of a refusal by the arm: of a goal of the profile "action"."""
UNREADABLE = "unreadable"
"""The reason of a refusal: reading the message failed."""
SILENCE = 1.0
"""An arm that has reported no state for this long, s, has a problem."""

DISCOVERY = 0.5
"""How long other nodes of a network take to be discovered, s."""
_POLL = 0.05


def installed(profile: Profile) -> tuple[Profile, tuple[str, ...]]:
    """A profile with the messages that are installed, and in what it differs from the one given."""
    if profile.states != "controller_state" or messages.control_msgs_installed():
        return profile, ()
    replaced = profile.with_joint_states()
    return replaced, (
        f"control_msgs is not installed, so the states come from {replaced.state_topic} (sensor_msgs/JointState) and not from "
        f"{profile.state_topic}",
    )


class RosLink:
    """The connection to one arm; see `gym_mara.ros2.arm.Link`.

    The states are read in the thread of the node. What is refused is counted by reason, and never ends that thread.

    Args:
        robot: the arm.
        profile: in which form it takes commands and reports states, and on which topics; or the name of a profile.
        controller, namespace, velocity: of a profile that is given by its name; see `make_profile`.
        node: the node to use, which is not closed with the link; by default one of its own.
        domain: the ROS domain of a node of its own; by default that of ROS_DOMAIN_ID, or 0.
        commands: whether commands will be sent. Without, no publisher of commands is made, which others would see.

    Raises:
        GymMaraError: the profile is not for this robot, or needs messages that are not installed.
        MissingExtraError: rclpy is not installed.
    """

    def __init__(
        self,
        robot: RobotModel,
        profile: Profile | str = "trajectory",
        *,
        controller: str | None = None,
        namespace: str = "",
        velocity: float | None = None,
        node: RosNode | None = None,
        domain: int | None = None,
        commands: bool = True,
    ) -> None:
        if isinstance(profile, Profile) and (namespace or (controller, velocity) != (None, None)):
            raise GymMaraError(
                "a Profile has its topics: give controller, namespace and velocity to make_profile"
            )
        own = profile
        if not isinstance(own, Profile):
            own = make_profile(own, controller=controller, namespace=namespace, velocity=velocity)
        own.check(robot.joint_names)
        own, self.notes = installed(own)
        """In what the connection differs from its profile."""
        action = messages.follow_joint_trajectory_type() if own.commands == "action" else None
        self.robot, self.profile = robot, own
        self._lock = threading.Lock()
        self._map = JointMap(robot)
        self._state: ArmState | None = None
        self._closed = False
        self._owns_node = node is None
        self._began = time.monotonic()
        self.node = RosNode("gym_mara_link", domain=domain) if node is None else node
        self._publisher: Any = None
        self._client: Any = None
        self.orders: dict[str, tuple[str, ...]] = {}
        """The joints that the controllers of positions tell, by their nodes; after `command_problems`."""
        self._action = action
        self._commands = commands
        self._connect(commands)

    def _connect(self, commands: bool) -> None:
        node, profile = self.node.node, self.profile
        self.state_type: Any = JointState
        """The type of the states' messages."""
        self.parse = messages.of_joint_state
        """Reads one."""
        if profile.states == "controller_state":
            self.state_type = messages.controller_state_type()
            self.parse = messages.of_controller_state
        self._subscription = node.create_subscription(
            self.state_type,
            profile.state_topic,
            self._hear,
            messages.SENSOR_DATA,
        )
        self._command_type = JointTrajectory
        if profile.commands == "positions":
            self._command_type = Float64MultiArray
        if self._action is not None:
            self._client = ActionClient(node, self._action, profile.command_topic)
        elif commands:
            self._publisher = node.create_publisher(
                self._command_type, profile.command_topic, self._qos
            )

    @property
    def _qos(self) -> Any:
        return messages.SENSOR_DATA if self.profile.best_effort else messages.RELIABLE

    @property
    def state(self) -> ArmState | None:
        """As in `Link`."""
        with self._lock:
            return self._state

    @property
    def refused(self) -> Mapping[str, int]:
        """As in `Link`."""
        with self._lock:
            return dict(self._map.refused)

    @property
    def last_refusal(self) -> str | None:
        """The reason of the last refusal of a state; None without one."""
        with self._lock:
            return self._map.last_refusal

    def _hear(self, message: Any, info: Any) -> None:
        """Read a state. It was received when the middleware says, however long this thread was held up since."""
        held_up = max(0.0, 1e-9 * (time.time_ns() - (info["received_timestamp"] or np.inf)))
        try:
            self._on_state(message, time.monotonic() - held_up)
        except Exception as error:  # whatever it is, the thread must go on
            with self._lock:
                self._map.refuse(UNREADABLE, f"{type(error).__name__}: {error}")

    def _on_state(self, message: Any, received: float) -> None:
        joints = self.parse(message)
        with self._lock:
            state = self._map.read(
                joints.names,
                joints.position,
                joints.velocity,
                joints.effort,
                received=received,
                stamp=joints.stamp,
            )
            if state is not None:
                self._state = state

    def send(self, setpoint: Setpoint, period: float) -> None:
        """As in `Link`.

        Raises:
            GymMaraError: the set-point is not finite or of another robot, or the link is closed or was made without commands.
        """
        shape = (self.robot.num_joints,)
        q, qd = setpoint.q, setpoint.qd
        if q.shape != shape or qd.shape != shape or not np.isfinite([q, qd]).all():
            raise GymMaraError(
                f"a set-point must have {shape[0]} finite positions and velocities, not q {q} and qd {qd}; nothing was sent"
            )
        if self._closed or not self._commands:
            raise GymMaraError(
                "the link is closed, or was made with commands=False; nothing was sent"
            )
        profile = self.profile
        if profile.commands == "positions":
            self._publisher.publish(messages.positions(q))
            return
        velocity = None if profile.velocity is None else np.full(shape, profile.velocity)
        names = self.robot.joint_names
        trajectory = messages.trajectory(names, q, velocity, profile.duration(period))
        if self._action is None:
            self._publisher.publish(trajectory)
        else:
            goal = self._client.send_goal_async(self._action.Goal(trajectory=trajectory))
            goal.add_done_callback(self._on_answer)

    def _on_answer(self, goal: Any) -> None:
        """Count a goal that the arm has refused."""
        if goal.exception() is not None or not goal.result().accepted:
            with self._lock:
                self._map.refuse(GOAL, "the action server did not accept a set-point")

    def wait(self, timeout: float) -> None:
        """Wait until the arm has reported a state, and nothing is wrong.

        Args:
            timeout: s.

        Raises:
            GymMaraError: something is wrong still; it says what.
        """
        end = time.monotonic() + timeout
        while True:
            now = time.monotonic()
            problems = self.problems() if now - self._began >= DISCOVERY or now >= end else None
            if problems == []:
                return
            if problems and now >= end:
                raise GymMaraError(
                    f"the arm is not ready after {timeout:g} s: {'; '.join(problems)}"
                )
            time.sleep(_POLL)

    def problems(self) -> list[str]:
        """What is wrong before motion, and what to do; empty if nothing is. Others take up to a second to be discovered."""
        return [*self.state_problems(), *self.command_problems()]

    def state_problems(self) -> list[str]:
        """What is wrong with the states."""
        topic, node = self.profile.state_topic, self.node.node
        found = graph.publishers(node, topic)
        if not found:
            return [
                f"nobody publishes {topic}: start the arm's driver with its joint_state_broadcaster, and check the ROS domain "
                f"({self.node.domain}) and the namespace"
            ]
        wanted = graph.type_name(self.state_type)
        other = [endpoint for endpoint in found if endpoint.type != wanted]
        if len(other) == len(found):
            return [
                f"{topic} has messages of the type {other[0].type}, and {wanted} is needed: choose another profile or state_topic"
            ]
        with self._lock:
            state, refused, last = self._state, Counter(self._map.refused), self._map.last_refusal
        if state is not None and time.monotonic() - state.received <= SILENCE:
            return []
        if not refused:
            silent = "has reported no state" if state is None else "has fallen silent"
            return [
                f"the arm {silent}: {graph.names(found)} publishes {topic}, and nothing arrives"
            ]
        if refused.most_common(1)[0][0] in (REPEATED, OUT_OF_ORDER):
            return [f"the clock of the states of {topic} does not advance: {last}"]
        return [f"no state of {topic} can be used: {last}"]

    def command_problems(self) -> list[str]:
        """What is wrong with the commands."""
        topic, node = self.profile.command_topic, self.node.node
        if self._client is not None:
            if self._client.server_is_ready():
                return []
            return [f"nobody serves the action {topic}: is the controller loaded and active?"]
        own = int(self._publisher is not None)
        problems = []
        if rivals := graph.others(graph.publishers(node, topic), node, own):
            problems.append(
                f"{graph.names(rivals)} publishes {topic} too: end it, because two commanders fight for the arm"
            )
        wanted = graph.type_name(self._command_type)
        found = graph.subscribers(node, topic)
        if not found:
            problems.append(
                f"nobody listens to {topic}: the controller is not loaded, or has another name or namespace "
                "(ros2 control list_controllers)"
            )
        elif all(endpoint.type != wanted for endpoint in found):
            problems.append(
                f"{topic} has messages of the type {found[0].type}, and {wanted} would be sent: choose another profile"
            )
        for endpoint in found:
            reason = graph.qos_problem(self._qos, endpoint.qos)
            if reason is not None:
                problems.append(f"commands do not reach {endpoint.node}: {reason}")
        if self.profile.commands == "positions":
            problems += self._order_problems({endpoint.node for endpoint in found})
        return problems

    def _order_problems(self, controllers: set[str]) -> list[str]:
        """What is wrong with the order of the joints of controllers, of those that tell it."""
        own = self.robot.joint_names
        for each in controllers - self.orders.keys():
            if (order := graph.joints_of(self.node.node, each)) is not None:
                self.orders[each] = order
        return [
            f"{each} has the joints {', '.join(order)} in its parameter joints, and numbers for {', '.join(own)} would be sent: "
            "give it the joints of the robot in this order, or choose another profile"
            for each, order in self.orders.items()
            if each in controllers and order != own
        ]

    def close(self) -> None:
        """As in `Link`."""
        if self._closed:
            return
        self._closed = True
        if self._owns_node:
            self.node.close()
            return
        node = self.node.node
        node.destroy_subscription(self._subscription)
        if self._publisher is not None:
            node.destroy_publisher(self._publisher)
        if self._client is not None:
            self._client.destroy()
