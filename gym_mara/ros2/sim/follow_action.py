"""The action FollowJointTrajectory of a simulated arm. It needs control_msgs, which only a sourced ROS has."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gym_mara.errors import GymMaraError
from gym_mara.ros2 import messages
from gym_mara.ros2.node import needs_ros
from gym_mara.ros2.sim.arm import DONE, RUNNING, SimulatedArm

with needs_ros("the action FollowJointTrajectory"):
    from rclpy.action import ActionServer, CancelResponse, GoalResponse
    from rclpy.task import Future


class FollowAction:
    """Serves the action: a goal ends when the arm has followed its trajectory, or when another command replaces it.

    Args:
        node: the ROS node.
        name: of the action.
        arm: the arm.
        delay_of: gives the time from now to the stamp of a header, s.
    """

    def __init__(
        self, node: Any, name: str, arm: SimulatedArm, delay_of: Callable[[Any], float]
    ) -> None:
        self._arm, self._delay_of = arm, delay_of
        self._node, self._log = node, node.get_logger()
        self._type = messages.follow_joint_trajectory_type()
        self._running: dict[int, tuple[Any, Any]] = {}
        self._server = ActionServer(
            node,
            self._type,
            name,
            self._execute,
            goal_callback=lambda _: GoalResponse.ACCEPT,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def update(self) -> None:
        """Stop the arm for goals that are cancelled, and wake those whose commands have ended; called after each tick."""
        for number, (goal, future) in list(self._running.items()):
            if (outcome := self._arm.outcome(number)) != RUNNING:
                del self._running[number]
                future.set_result(outcome)
                if (executor := self._node.executor) is not None:
                    executor.wake()  # it does not see by itself what another thread has set
            elif goal.is_cancel_requested:
                self._arm.follow((), ())

    async def _execute(self, goal: Any) -> Any:
        """Follow a goal's trajectory, and return the result; in the thread of the node."""
        result = self._type.Result()
        trajectory = goal.request.trajectory
        try:
            points, delay = messages.points(trajectory), self._delay_of(trajectory.header)
            number = self._arm.follow(trajectory.joint_names, points, delay)
        except GymMaraError as error:
            self._log.warning(f"refused: {error}", throttle_duration_sec=1.0)
            result.error_code, result.error_string = self._type.Result.INVALID_GOAL, str(error)
            goal.abort()
            return result
        future = Future()
        self._running[number] = goal, future
        if await future == DONE:
            goal.succeed()
        elif goal.is_cancel_requested:
            goal.canceled()
        else:
            result.error_string = "another command took its place"
            goal.abort()
        return result
