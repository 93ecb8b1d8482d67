"""The reach task of ROS2Learn: bring the end effector to a pose. Its variants are the four MARA environments."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gym_mara import rotations
from gym_mara.arrays import Constants, zeros_like
from gym_mara.errors import GymMaraError, flag
from gym_mara.state import SimState
from gym_mara.tasks import observation, rewards
from gym_mara.tasks.base import Task, Workspace
from gym_mara.tasks.goal import Goal
from gym_mara.tasks.observation import Part
from gym_mara.types import Floats, Mask

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel

_REACH_TOLERANCE = (1e-3, 1e-2)
"""A target is out of reach if the arm comes no closer than this distance, m, and this angle, rad."""
# The smallest and the largest positive value of each constant of the reward, its unit, and whether it can be zero.
_RANGES = {
    "alpha": (1e-3, 1e3, "", False),
    "beta": (1e-3, 1e2, "", False),
    "gamma": (1e-9, 1e6, "", True),
    "delta": (1e-9, 1e6, "", True),
    "eta": (1e-9, 1e3, "", True),
    "kappa": (1e-3, 1e3, "", False),
}
# The second takes the Euclidean norm of three components to their root mean square.
_ONE_AND_RMS = Constants(1.0, 3.0**-0.5)


@dataclass(frozen=True)
class ReachTask(Task):
    """Bring the end-effector frame to a target pose. Each value is a keyword argument of the environments."""

    orientation: bool = False
    """Whether the reward and the observation include the orientation."""
    collision_penalty: bool = False
    """Whether the reward includes a penalty for collisions."""
    target_position: tuple[float, ...] | None = None
    """The target position (3,), m, in the world frame; None for the robot's default target."""
    target_quaternion: tuple[float, ...] | None = None
    """The target orientation (4,), [w, x, y, z], in the world frame; None for the robot's default target."""
    alpha: float = 5.0
    """The steepness of the distance reward, 1/m."""
    beta: float = 1.5
    """The exponent of the orientation factor."""
    gamma: float = 1.0
    """The offset of the orientation factor. A larger offset gives the orientation less weight."""
    delta: float = 3.0
    """The largest collision penalty."""
    eta: float = 0.03
    """The exponent of the distance in the collision penalty."""
    kappa: float = 0.02
    """The width of the narrow peak of the distance reward, relative to its wide basin."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("orientation", "collision_penalty"):
            object.__setattr__(self, name, flag(name, getattr(self, name)))
        self._make_plain("target_position", 3)
        self._make_plain("target_quaternion", 4)
        if self.target_quaternion is not None:
            check_unit("target_quaternion", self.target_quaternion)
        self._check_ranges(_RANGES, "the reward is not accurate with others")

    def goal(self, robot: RobotModel, workspace: Workspace, num_envs: int) -> Goal:
        """The target pose of each arm; warns if a target that the user gave is out of reach."""
        given = (self.target_position, self.target_quaternion)
        default: tuple[Any, Any] = (None, None)
        if None in given:
            own = robot.target
            default = (own.position, own.quaternion) if own else workspace.default_pose()
        position, quaternion = (
            np.array(value if value is not None else fallback, dtype=np.float64)
            for value, fallback in zip(given, default, strict=True)
        )
        quaternion = rotations.canonical(rotations.normalised(quaternion))
        if given != (None, None):
            far = out_of_reach(robot, workspace, position, quaternion if self.orientation else None)
            if far:
                warnings.warn(far, stacklevel=2)
        return Goal(np.tile(position, (num_envs, 1)), np.tile(quaternion, (num_envs, 1)))

    def farthest(self, robot: RobotModel, goal: Goal) -> float:
        """The largest possible distance of a target from the world's origin, m."""
        return float(np.linalg.norm(goal.position, axis=-1).max())

    def observation(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Sequence[Part]:
        """Joint positions, position error, orientation error with `orientation`, and velocity of the end effector."""
        parts = [
            observation.joint_positions(robot),
            observation.position_error(robot, self.farthest(robot, goal)),
        ]
        if self.orientation:
            parts.append(observation.orientation_error())
        return [*parts, observation.tool_velocity(robot, joint_velocity)]

    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        """The reward r_dist · r_orient - 1 - r_coll, and its terms.

        The terms are `distance` (m, the root mean square of the error's components, which the reward uses),
        `position_error` (m, the Euclidean distance), `angle_error` (rad), `reward_distance` (r_dist),
        `reward_orientation` (r_orient) and `reward_collision` (r_coll).
        """
        return self.judge(state.ee_position, state.ee_quaternion, state.collided, goal)

    def judge(
        self, position: Floats, quaternion: Floats, collided: Mask, goal: Goal
    ) -> tuple[Floats, dict[str, Floats]]:
        """The reward and its terms, as in `reward`, of end effectors at positions (N, 3), m, and quaternions (N, 4)."""
        error = position - goal.position
        xp, one, rms = _ONE_AND_RMS.like(error)
        position_error = xp.sqrt(xp.vecdot(error, error))
        distance = position_error * rms
        angle = rotations.angle_between(quaternion, goal.quaternion)
        near = rewards.distance_reward(distance, self.alpha, self.kappa)
        aligned = collision = None
        if self.orientation:
            aligned = rewards.orientation_factor(angle, self.beta, self.gamma)
        if self.collision_penalty:
            collision = rewards.collision_penalty(collided, distance, self.delta, self.eta)
        total = (near if aligned is None else near * aligned) - one
        if collision is not None:
            total -= collision
        return total, {
            "distance": distance,
            "position_error": position_error,
            "angle_error": angle,
            "reward_distance": near,
            "reward_orientation": zeros_like(near) + one if aligned is None else aligned,
            "reward_collision": zeros_like(near) if collision is None else collision,
        }


def check_unit(name: str, quaternion: Sequence[float]) -> None:
    """Check that a quaternion (4,) has length 1, but for rounding.

    Raises:
        GymMaraError: it has not.
    """
    length = np.linalg.norm(quaternion)
    if abs(length - 1.0) > 1e-3:
        raise GymMaraError(
            f"{name} {tuple(quaternion)} has length {length:.4f}; give a unit quaternion [w, x, y, z]"
        )


def out_of_reach(
    robot: RobotModel, workspace: Workspace, position: Floats | None, quaternion: Floats | None
) -> str:
    """Why a target is out of reach, and how close the arm can come; empty for one within reach.

    Args:
        robot: the arm.
        workspace: of the arm.
        position: of the target (3,), m; None if any position will do.
        quaternion: of the target, [w, x, y, z]; None if any orientation will do.
    """
    distance, angle = workspace.shortfall(position, quaternion)
    if distance <= _REACH_TOLERANCE[0] and angle <= _REACH_TOLERANCE[1]:
        return ""
    target = [values.tolist() for values in (position, quaternion) if values is not None]
    away = [f"{1000 * distance:.1f} mm"] if position is not None else []
    away += [f"{np.degrees(angle):.1f}°"] if quaternion is not None else []
    return (
        f"the target {' with '.join(map(str, target))} is out of reach of {robot.name}'s {robot.ee_frame!r}: "
        f"the closest pose is {' and '.join(away)} away"
    )
