"""Messages of ROS as plain numbers, and plain numbers as messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from gym_mara.errors import GymMaraError
from gym_mara.ros2.node import needs_ros
from gym_mara.ros2.sim.trajectories import Point
from gym_mara.types import Floats

with needs_ros("ROS 2"):
    from builtin_interfaces.msg import Duration, Time
    from rclpy.qos import (
        DurabilityPolicy,
        HistoryPolicy,
        QoSProfile,
        ReliabilityPolicy,
    )
    from std_msgs.msg import Float64MultiArray
    from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

RELIABLE = QoSProfile(depth=10)
"""How commands and a simulated arm's states are published."""
SENSOR_DATA = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=5, reliability=ReliabilityPolicy.BEST_EFFORT
)
"""How states are read: every publisher can serve it."""
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
"""How what does not change is published: those who come later get it too."""


class Joints(NamedTuple):
    """What a message says of joints."""

    names: Sequence[str]
    position: Sequence[float]
    velocity: Sequence[float]
    effort: Sequence[float]
    stamp: float
    """s; 0 for none."""


def seconds(time: Any) -> float:
    """A time or a duration of ROS, s."""
    return float(time.sec) + 1e-9 * float(time.nanosec)


def duration(time: float) -> Any:
    """A duration of ROS; the time in s."""
    whole = math.floor(time)
    return Duration(sec=whole, nanosec=min(round((time - whole) * 1e9), 999_999_999))


def stamp(time: float) -> Any:
    """A time of ROS; the time in s."""
    whole = math.floor(time)
    return Time(sec=whole, nanosec=min(round((time - whole) * 1e9), 999_999_999))


def of_joint_state(message: Any) -> Joints:
    """What a sensor_msgs/JointState says."""
    return Joints(
        message.name,
        message.position,
        message.velocity,
        message.effort,
        seconds(message.header.stamp),
    )


def of_controller_state(message: Any) -> Joints:
    """What a control_msgs/JointTrajectoryControllerState says: `feedback`, or `actual` before ROS 2 Jazzy."""
    point = message.feedback if hasattr(message, "feedback") else message.actual
    time = seconds(message.header.stamp)
    return Joints(message.joint_names, point.positions, point.velocities, point.effort, time)


def trajectory(
    names: Sequence[str], position: Floats, velocity: Floats | None, time_from_start: float
) -> Any:
    """A trajectory_msgs/JointTrajectory of one point, which starts when it arrives."""
    point = JointTrajectoryPoint(
        positions=position.tolist(), time_from_start=duration(time_from_start)
    )
    if velocity is not None:
        point.velocities = velocity.tolist()
    return JointTrajectory(joint_names=list(names), points=[point])


def points(message: Any) -> list[Point]:
    """The points of a trajectory_msgs/JointTrajectory."""
    return [
        Point(point.positions, point.velocities, seconds(point.time_from_start))
        for point in message.points
    ]


def positions(position: Floats) -> Any:
    """A std_msgs/Float64MultiArray of joint positions."""
    return Float64MultiArray(data=position.tolist())


def control_msgs_installed() -> bool:
    """Whether control_msgs can be imported; only a sourced ROS has it."""
    try:
        import control_msgs.msg
    except ImportError:
        return False
    return control_msgs.msg is not None


def controller_state_type() -> Any:
    """The type control_msgs/JointTrajectoryControllerState."""
    from control_msgs.msg import JointTrajectoryControllerState

    return JointTrajectoryControllerState


def follow_joint_trajectory_type() -> Any:
    """The type of the action control_msgs/FollowJointTrajectory.

    Raises:
        GymMaraError: control_msgs cannot be imported.
    """
    try:
        from control_msgs.action import FollowJointTrajectory
    except ImportError as error:
        raise GymMaraError(
            "the action FollowJointTrajectory needs control_msgs, which is in no wheel: source a ROS 2 that has it for this "
            "Python, or choose the profile 'trajectory', which is the topic of the same controller"
        ) from error
    return FollowJointTrajectory
