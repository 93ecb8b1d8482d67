"""The poses that an arm can reach, for tasks, which do not depend on a collision engine."""

from __future__ import annotations

import numpy as np

from gym_mara.collision.coal import touching_links
from gym_mara.collision.configurations import Configurations
from gym_mara.collision.free_poses import FreePoses, reachable_pose
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.inverse_kinematics import miss, solve_ik
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.tasks.base import Draw
from gym_mara.types import Floats

_SEARCHES = 50
"""In 900 random free poses of three robots the fifth search at the latest found a configuration without a collision."""


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

    def configurations(self, position: Floats, quaternion: Floats | None, start: Floats) -> Floats:
        """Collision-free configurations (N, K, J), rad (m), at N poses or positions; infinite where fewer are found.

        On the straight way from the start (N, J) to the nearest one there is no collision, if that can be had.
        """
        posed = quaternion is not None
        if posed not in self._configurations:
            self._configurations[posed] = Configurations(self._robot, posed)
        return self._configurations[posed](position, quaternion, start)

    @property
    def _poses(self) -> FreePoses:
        if self._free_poses is None:
            self._free_poses = FreePoses(self._robot)
        return self._free_poses

    def default_pose(self) -> tuple[Floats, Floats]:
        """The pose of a collision-free configuration, always the same for a robot."""
        return reachable_pose(self._robot)

    def pose_with(
        self,
        position: Floats | None,
        quaternion: Floats | None,
        generator: np.random.Generator | None = None,
    ) -> tuple[Floats, Floats]:
        """The pose of a collision-free configuration, with a position or an orientation, or both, that are within reach.

        Args:
            position: (3,), m; None for any.
            quaternion: [w, x, y, z]; None for any.
            generator: it chooses what is None; without one it is always the same.

        Raises:
            GymMaraError: the arm collides in every configuration that _SEARCHES searches of inverse kinematics find.
        """
        low, high = reachable_range(self._robot)
        size = _SEARCHES - 1, len(low)
        starts = np.vstack([self.home, np.random.default_rng(0).uniform(low, high, size)])
        if generator is not None:
            starts = np.vstack([generator.uniform(low, high, size), starts])
        for start in starts:
            q = solve_ik(self._robot, position, quaternion, start)
            if not touching_links(self._robot, q):
                found = self._robot.kinematics().pose(q[None])
                return (
                    found[0][0] if position is None else position,
                    found[1][0] if quaternion is None else quaternion,
                )
        target = " with ".join(str(v.tolist()) for v in (position, quaternion) if v is not None)
        raise GymMaraError(
            f"{self._robot.name} collides in every configuration that {_SEARCHES} searches found for the target {target}: "
            "give another target"
        )

    def shortfall(self, position: Floats | None, quaternion: Floats | None) -> tuple[float, float]:
        """How close the arm can come to a pose: the remaining distance, m, and the remaining angle, rad.

        None stands for any position, or any orientation.
        """
        return miss(self._robot, position, quaternion)
