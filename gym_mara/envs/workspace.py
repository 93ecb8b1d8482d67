"""Which poses an arm can reach, for tasks, which know no engine."""

from __future__ import annotations

import numpy as np

from gym_mara.collision.free_poses import FreePoses, reachable_pose
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import miss
from gym_mara.types import Floats


class RobotWorkspace:
    """The poses of a robot's end effector; what looks for them is made when it is first needed.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._free_poses: FreePoses | None = None

    def draw(self, generator: np.random.Generator) -> tuple[Floats, Floats]:
        """The pose of a random configuration without a collision.

        Raises:
            GymMaraError: nearly every configuration of the robot collides.
        """
        if self._free_poses is None:
            self._free_poses = FreePoses(self._robot)
        return self._free_poses.draw(generator)

    def default_pose(self) -> tuple[Floats, Floats]:
        """The pose of a configuration without a collision, always the same for a robot."""
        return reachable_pose(self._robot)

    def shortfall(self, position: Floats, quaternion: Floats | None) -> tuple[float, float]:
        """How near the arm can come to a pose: the distance left, m, and the angle left, rad."""
        return miss(self._robot, position, quaternion)
