"""The reach task with a random target in each episode; the observation contains the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.tasks import observation
from gym_mara.tasks.base import Workspace
from gym_mara.tasks.goal import Goal
from gym_mara.tasks.observation import Part
from gym_mara.tasks.reach import ReachTask
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel


@dataclass(frozen=True)
class RandomReachTask(ReachTask):
    """Bring the end effector to a random target pose, drawn for each episode.

    The target is the pose of a random collision-free configuration, so it can be reached.
    """

    random_goal: ClassVar[bool] = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target_position is not None or self.target_quaternion is not None:
            raise GymMaraError(
                "this task draws its targets: give target_position and target_quaternion to reset, in its options, or choose MARA-v0"
            )

    def draw_goal(
        self, workspace: Workspace, generator: np.random.Generator
    ) -> tuple[Floats, Floats]:
        return workspace.draw(generator)

    def farthest(self, robot: RobotModel, goal: Goal) -> float:
        return robot.extent

    def observation(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Sequence[Part]:
        """The parts of ReachTask, then the position of the target, and its quaternion with `orientation`."""
        parts = [*super().observation(robot, goal, joint_velocity)]
        parts.append(observation.target_position(robot))
        if self.orientation:
            parts.append(observation.target_quaternion())
        return parts
