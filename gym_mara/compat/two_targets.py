"""The task of gym-gazebo2's MARARandomTarget-v0: one of two targets in each episode, which the observation does not contain."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.tasks import Goal, ReachTask, Workspace
from gym_mara.tasks.reach import out_of_reach
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel

TARGETS = ((-0.2, -0.5, 0.93), (0.2, -0.5, 0.93))
"""The two targets, m, in the world.

gym-gazebo2 has them at (-0.5, ±0.2, 0.25) from the arm's base, which stands unturned at the origin of its scene. Here the
base stands on the table, 0.68 m above the floor, turned by π/2 about z.
"""

_DOWN = (0.0, 0.7071068, 0.7071068, 0.0)


@dataclass(frozen=True)
class TwoTargetsTask(ReachTask):
    """Bring the end effector to one of TARGETS, drawn for each episode with equal chances.

    Reward and observation are those of ReachTask: the agent sees the position error, and not the target.
    """

    random_goal: ClassVar[bool] = True
    target_quaternion: tuple[float, ...] = _DOWN

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.target_position is not None:
            raise GymMaraError(
                "this task draws its targets: leave out target_position, or choose MARA-v0"
            )

    def goal(self, robot: RobotModel, workspace: Workspace, num_envs: int) -> Goal:
        """The first target for each arm before the first episode; warns if one is out of reach."""
        quaternion = np.array(self.target_quaternion)
        for target in TARGETS:
            oriented = quaternion if self.orientation else None
            if far := out_of_reach(robot, workspace, np.array(target), oriented):
                warnings.warn(far, stacklevel=2)
                break
        return Goal(np.tile(TARGETS[0], (num_envs, 1)), np.tile(quaternion, (num_envs, 1)))

    def draw_goal(
        self, workspace: Workspace, generator: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """One of the targets."""
        return np.array(TARGETS[generator.integers(2)]), np.array(self.target_quaternion)
