"""The reach task with another target in each episode, which the observation shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.tasks import observation
from gym_mara.tasks.base import Goal, Workspace
from gym_mara.tasks.observation import Part
from gym_mara.tasks.reach import ReachTask
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel


@dataclass(frozen=True)
class RandomReachTask(ReachTask):
    """Bring the end effector to a pose that is drawn for each episode, one of a configuration without a collision."""

    random_goal: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target_position is not None or self.target_quaternion is not None:
            raise GymMaraError(
                "this task draws its targets: leave out target_position and target_quaternion, or take MARA-v0"
            )

    def draw_goal(
        self, workspace: Workspace, generator: np.random.Generator
    ) -> tuple[Floats, Floats]:
        return workspace.draw(generator)

    def farthest(self, robot: RobotModel, goal: Goal) -> float:
        return robot.extent

    def observation(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Sequence[Part]:
        """As ReachTask, then the target's position, and its quaternion if the orientation counts."""
        parts = [*super().observation(robot, goal, joint_velocity)]
        parts.append(observation.target_position(robot))
        if self.orientation:
            parts.append(observation.target_quaternion())
        return parts
