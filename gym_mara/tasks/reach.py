"""The reach task of ROS2Learn: bring the tool to a pose. Its variants are the four MARA environments."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gym_mara import rotations
from gym_mara.collision.free_poses import reachable_pose
from gym_mara.errors import GymMaraError, positive_number
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import miss
from gym_mara.state import SimState
from gym_mara.tasks import rewards
from gym_mara.tasks.base import Floats, Goal, Task

# Robot → target position (m), quaternion [w, x, y, z]; MARA's is gym-gazebo2's, the tool pointing straight down.
_TARGETS: dict[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "mara": ((-0.40028, 0.095615, 0.72466), (0.0, 0.7071068, 0.7071068, 0.0)),
}
# A target that the arm misses by more than this (m, rad) brings a warning.
_REACH_TOLERANCE = (1e-3, 1e-2)
# As arrays: a ufunc on one row takes a Python number at twice the cost.
_ONE, _RMS = np.array(1.0), np.array(3.0**-0.5)


@dataclass(frozen=True)
class ReachTask(Task):
    """Bring the end-effector frame to a target pose; every value is a keyword argument of the environments."""

    orientation: bool = False
    """Whether the reward weighs, and the observation shows, the orientation."""
    collision_penalty: bool = False
    """Whether the reward punishes a collision."""
    target_position: tuple[float, ...] | None = None
    """m, in the world frame; None for the robot's own target."""
    target_quaternion: tuple[float, ...] | None = None
    """[w, x, y, z]; None for the robot's own."""
    alpha: float = 5.0
    """Steepness of the distance reward, 1/m."""
    beta: float = 1.5
    """Exponent of the orientation factor."""
    gamma: float = 1.0
    """Offset of the orientation factor: the larger, the less the orientation weighs."""
    delta: float = 3.0
    """Size of the collision penalty."""
    eta: float = 0.03
    """Exponent of the distance in the collision penalty."""
    kappa: float = 0.02
    """Width of the peak of the distance reward, relative to its basin."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("orientation", "collision_penalty"):
            if not isinstance(getattr(self, name), bool):
                raise GymMaraError(f"{name} must be True or False, not {getattr(self, name)!r}")
        self._make_plain("target_position", 3)
        self._make_plain("target_quaternion", 4)
        quaternion = self.target_quaternion
        if quaternion is not None and abs(np.linalg.norm(quaternion) - 1.0) > 1e-3:
            raise GymMaraError(
                f"target_quaternion {quaternion} has length {np.linalg.norm(quaternion):.4f}; "
                "give a unit quaternion [w, x, y, z]"
            )
        for name in ("alpha", "beta", "gamma", "delta", "eta", "kappa"):
            or_zero = name in ("gamma", "delta", "eta")
            positive_number(name, getattr(self, name), or_zero=or_zero)

    def goal(self, robot: RobotModel, num_envs: int) -> Goal:
        """The target pose for each arm; warns where a target that was asked for is out of reach."""
        asked = (self.target_position, self.target_quaternion)
        own: tuple[Any, Any] = (None, None)
        if None in asked:
            own = _TARGETS.get(robot.name) or reachable_pose(robot)
        position, quaternion = (
            np.array(mine if mine is not None else robots, dtype=np.float64)
            for mine, robots in zip(asked, own, strict=True)
        )
        quaternion = rotations.canonical(rotations.normalised(quaternion))
        if asked != (None, None):
            _warn_if_out_of_reach(robot, position, quaternion if self.orientation else None)
        return Goal(np.tile(position, (num_envs, 1)), np.tile(quaternion, (num_envs, 1)))

    def observation_space(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Box:
        distance = robot.extent + np.linalg.norm(goal.position, axis=-1).max()
        speed = (robot.reach * joint_velocity).sum()
        high = [robot.upper, np.full(3, distance), np.full(3, speed)]
        low = [robot.lower, np.full(3, -distance), np.full(3, -speed)]
        if self.orientation:
            one = 1.0 + 1e-9  # a unit quaternion is one but for rounding
            high.insert(2, np.full(4, one))
            low.insert(2, np.array([0.0, -one, -one, -one]))
        return Box(np.concatenate(low), np.concatenate(high), dtype=np.float64)

    def observe(self, state: SimState, goal: Goal) -> Floats:
        """[q, position error (3) m, orientation error (4) if it counts, linear velocity (3) m/s] per arm.

        The orientation error is q_ee ⊗ conj(q_target) as [w, x, y, z], w >= 0.
        """
        parts = [state.q, state.ee_position - goal.position, state.ee_velocity]
        if self.orientation:
            parts.insert(2, goal.orientation_error(state.ee_quaternion))
        return np.concatenate(parts, axis=-1)

    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        """r_dist · r_orient - 1 - r_coll, and its terms.

        The terms: `distance` d (m, root mean square of the error's components, which the reward uses),
        `position_error` (m, Euclidean), `angle_error` (rad), and `reward_distance`, `reward_orientation`,
        `reward_collision`.
        """
        return self.judge(state.ee_position, state.ee_quaternion, state.collided, goal)

    def judge(
        self, position: Floats, quaternion: Floats, collided: NDArray[np.bool_], goal: Goal
    ) -> tuple[Floats, dict[str, Floats]]:
        """The reward of tools at a position (N, 3), m, and a quaternion (N, 4), and its terms, as `reward` has them."""
        error = position - goal.position
        position_error = np.sqrt(np.vecdot(error, error))
        distance = position_error * _RMS
        angle = rotations.angle_between(quaternion, goal.quaternion)
        near = rewards.distance_reward(distance, self.alpha, self.kappa)
        aligned = collision = None
        if self.orientation:
            aligned = rewards.orientation_factor(angle, self.beta, self.gamma)
        if self.collision_penalty:
            collision = rewards.collision_penalty(collided, distance, self.delta, self.eta)
        total = (near if aligned is None else near * aligned) - _ONE
        if collision is not None:
            total -= collision
        return total, {
            "distance": distance,
            "position_error": position_error,
            "angle_error": angle,
            "reward_distance": near,
            "reward_orientation": np.ones(len(near)) if aligned is None else aligned,
            "reward_collision": np.zeros(len(near)) if collision is None else collision,
        }


def _warn_if_out_of_reach(robot: RobotModel, position: Floats, quaternion: Floats | None) -> None:
    distance, angle = miss(robot, position, quaternion)
    if distance > _REACH_TOLERANCE[0] or angle > _REACH_TOLERANCE[1]:
        turn = f" and {np.degrees(angle):.1f}°" if quaternion is not None else ""
        warnings.warn(
            f"the target {position.tolist()} is out of reach of {robot.name}'s {robot.ee_frame!r}: "
            f"it comes no nearer than {1000 * distance:.1f} mm{turn}",
            stacklevel=3,
        )
