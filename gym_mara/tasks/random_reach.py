"""The reach task with another target in each episode, which is part of the observation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from gymnasium.spaces import Box

from gym_mara.collision.free_poses import FreePoses
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.tasks.base import Floats, Goal
from gym_mara.tasks.reach import ReachTask


@dataclass(frozen=True)
class RandomReachTask(ReachTask):
    """Bring the end-effector frame to a pose that a collision-free configuration has, drawn for each episode."""

    random_goal: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target_position is not None or self.target_quaternion is not None:
            raise GymMaraError(
                "this task draws its targets: leave out target_position and target_quaternion, or take MARA-v0"
            )

    def draw_goal(self, poses: FreePoses, generator: np.random.Generator) -> tuple[Floats, Floats]:
        return poses.draw(generator)

    def observation_space(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Box:
        farthest = Goal(np.array([[robot.extent, 0.0, 0.0]]), goal.quaternion[:1])
        space = super().observation_space(robot, farthest, joint_velocity)
        high = [np.full(3, robot.extent)]
        low = [np.full(3, -robot.extent)]
        if self.orientation:
            one = 1.0 + 1e-9
            high.append(np.full(4, one))
            low.append(np.array([0.0, -one, -one, -one]))
        return Box(
            np.concatenate([space.low, *low]), np.concatenate([space.high, *high]), dtype=np.float64
        )

    def observe(self, state: SimState, goal: Goal) -> Floats:
        """As ReachTask, then the target: position (3), m, and quaternion (4) [w, x, y, z] if the orientation counts."""
        parts = [super().observe(state, goal), goal.position]
        if self.orientation:
            parts.append(goal.quaternion)
        return np.concatenate(parts, axis=-1)
