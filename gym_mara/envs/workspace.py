"""The poses that an arm can reach, for tasks, which do not depend on a collision engine."""

from __future__ import annotations

import numpy as np

from gym_mara.collision.configurations import Configurations
from gym_mara.collision.free_poses import FreePoses, reachable_pose
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import miss
from gym_mara.tasks.base import Draw
from gym_mara.types import Floats


class RobotWorkspace:
    """The poses that a robot's end effector can reach. The search for free poses is prepared at its first use.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self.home = robot.home
        self._free_poses: FreePoses | None = None
        self._configurations: dict[bool, Configurations] = {}

    def draw(self, generator: np.random.Generator) -> tuple[Floats, Floats]:
        """The pose of a random collision-free configuration.

        Raises:
            GymMaraError: almost all configurations of the robot collide.
        """
        return self._poses.draw(generator)

    def draw_move(self, generator: np.random.Generator, start: Floats | None = None) -> Draw:
        """A random start and the pose of another configuration, with a free joint move between them.

        Raises:
            GymMaraError: almost all configurations of the robot, or all moves from the start, collide.
        """
        return Draw(*self._poses.draw_move(generator, start))

    def configurations(self, position: Floats, quaternion: Floats | None) -> Floats:
        """Collision-free configurations (N, K, J), rad (m), at N poses or positions; infinite where fewer are found."""
        posed = quaternion is not None
        if posed not in self._configurations:
            self._configurations[posed] = Configurations(self._robot, posed)
        return self._configurations[posed](position, quaternion)

    @property
    def _poses(self) -> FreePoses:
        if self._free_poses is None:
            self._free_poses = FreePoses(self._robot)
        return self._free_poses

    def default_pose(self) -> tuple[Floats, Floats]:
        """The pose of a collision-free configuration, always the same for a robot."""
        return reachable_pose(self._robot)

    def shortfall(self, position: Floats, quaternion: Floats | None) -> tuple[float, float]:
        """How close the arm can come to a pose: the remaining distance, m, and the remaining angle, rad."""
        return miss(self._robot, position, quaternion)
