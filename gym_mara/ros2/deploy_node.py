"""What a deployment offers to other nodes: a topic for targets, services to stop and resume, and diagnostics."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError, finite_numbers, one_of
from gym_mara.ros2 import messages
from gym_mara.ros2.deploy import Deployment, Target
from gym_mara.ros2.diagnostics import Diagnostics
from gym_mara.ros2.node import RosNode, needs_ros
from gym_mara.tasks.reach import check_unit

with needs_ros("a deployment"):
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from geometry_msgs.msg import PoseStamped
    from std_srvs.srv import Trigger

DIAGNOSTICS = "/diagnostics"
_EVERY = 1.0
"""How often diagnostics are published, s."""


class DeployNode:
    """Connects a deployment to other nodes; it uses the node of the connection to the arm, and ends with it.

    Args:
        deployment: the deployment.
        ros: the node.
        log: is called with a sentence about each refused target.

    Raises:
        GymMaraError: another node serves the same stop or resume: one call would stop or resume two arms.
    """

    def __init__(self, deployment: Deployment, ros: RosNode, log: Callable[[str], None]) -> None:
        self._deployment, self._ros, self._log = deployment, ros, log
        node = ros.node
        target, stop, resume = (
            deployment.target_topic,
            deployment.stop_service,
            deployment.resume_service,
        )
        for service in (stop, resume):
            if node.count_services(service):
                raise GymMaraError(
                    f"another node serves {service} already, so that one call would reach two arms: end the policy that is deployed "
                    "there (one that was killed is forgotten after some seconds), or give each arm its own namespace or ROS domain"
                )
        model = deployment.simulation.robot.model
        self._frames: dict[str, pin.SE3] = {
            "world": pin.SE3.Identity(),
            **{f.name: f.placement for f in model.frames if f.parentJoint == 0},
        }
        """The frames that do not move, in the world."""
        self._publisher = node.create_publisher(DiagnosticArray, DIAGNOSTICS, messages.RELIABLE)
        self._own: list[Any] = [
            node.create_service(Trigger, stop, self._stop),
            node.create_service(Trigger, resume, self._resume),
            node.create_timer(_EVERY, self._report),
        ]
        what = "the task's own target, to which the arm moves at once"
        if deployment.follows:
            what = f"targets on {target}"
            self._own.append(
                node.create_subscription(PoseStamped, target, self._aim, messages.RELIABLE)
            )
        self.offered = f"{what}, services {stop} and {resume}"
        """What there is for other nodes and operators, in words."""

    def _aim(self, message: Any) -> None:
        try:
            name = message.header.frame_id.lstrip("/") or "world"
            frame = one_of("frame of a target", name, self._frames)
            self._deployment.aim(
                _target(message.pose, self._frames[frame], self._deployment.oriented)
            )
        except GymMaraError as error:
            self._log(str(error))

    def _stop(self, _: Any, response: Any) -> Any:
        try:
            self._deployment.stop(f"the service {self._deployment.stop_service} was called")
            response.success, response.message = True, "the arm stops"
        except GymMaraError as error:
            response.success, response.message = False, str(error)
        return response

    def _resume(self, _: Any, response: Any) -> Any:
        try:
            self._deployment.resume()
            response.success, response.message = True, "the arm moves again"
        except GymMaraError as error:
            response.success, response.message = False, str(error)
        return response

    def _report(self) -> None:
        found = self._deployment.diagnostics
        message = DiagnosticArray(status=[_status(found)])
        message.header.stamp = messages.stamp(self._ros.now())
        self._publisher.publish(message)


def _target(pose: Any, frame: pin.SE3, oriented: bool) -> Target:
    """The target of a pose message in a frame.

    Raises:
        GymMaraError: a value is not finite, or the quaternion is not of length 1.
    """
    point, turn = pose.position, pose.orientation
    position = finite_numbers("the position of the target", [point.x, point.y, point.z])
    position = frame.act(np.array(position)).tolist()
    if not oriented:
        return Target(tuple(position))
    values = finite_numbers("the orientation of the target", [turn.w, turn.x, turn.y, turn.z])
    check_unit("the orientation of the target", values)
    world = pin.Quaternion(frame.rotation) * pin.Quaternion(*values)
    x, y, z, w = world.coeffs().tolist()
    return Target(tuple(position), (w, x, y, z))


def _status(found: Diagnostics) -> Any:
    """The diagnostics as a status message."""
    return DiagnosticStatus(
        level=DiagnosticStatus.ERROR if found.in_trouble else DiagnosticStatus.OK,
        name="gym_mara: deploy",
        message=found.status,
        hardware_id="",
        values=[KeyValue(key=key, value=value) for key, value in found.rows()],
    )
