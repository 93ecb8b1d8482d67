"""The collision-free configurations of poses, searched for many poses at once.

`gym_mara.robot.inverse_kinematics` finds one configuration, exactly. Here many starts descend together: a pose takes about 8 ms
alone, and less than 3 ms among others. Some of its configurations are found, but not all. Of 256 random poses none of MARA and UR5, and
one of Panda, had none. The configuration that a pose was made of was among them in 84 % of the poses of MARA and, but for whole
turns of joints, in 86 % of those of UR5; Panda has endlessly many.
"""

from __future__ import annotations

import numpy as np

from gym_mara import rotations
from gym_mara.collision.coal import CoalChecker
from gym_mara.collision.free_poses import straight_move
from gym_mara.collision.room import room_checker
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import nearest_turns, reachable_range
from gym_mara.types import Floats

STARTS = 32
"""From how many random configurations the search descends."""
_STEPS = 20
_LENGTH = 0.2
"""How much an angle counts beside a distance, m/rad."""
_LONGEST = 0.5
"""How far a joint moves in a step, rad (m)."""
_DAMPING = 0.025
"""Of the least squares, relative to the largest error, m."""
_REACHED = 1e-3
"""The largest error of a configuration, m."""
_WAYS = 6
"""How many of the nearest configurations are tried for a free way."""


class Configurations:
    """Finds configurations of poses.

    Args:
        robot: the arm.
        orientation: whether a pose has an orientation.
    """

    def __init__(self, robot: RobotModel, orientation: bool) -> None:
        self._robot, self._kinematics = robot, robot.kinematics()
        self._free = CoalChecker(robot)
        self._with_room = room_checker(robot)
        self._low, self._high = reachable_range(robot)
        self._rows = 6 if orientation else 3
        starts = (STARTS, robot.num_joints)
        self._starts = np.random.default_rng(0).uniform(self._low, self._high, starts)

    def __call__(self, position: Floats, quaternion: Floats | None, start: Floats) -> Floats:
        """Configurations (N, STARTS, J), rad (m), of poses; infinite where the search ends elsewhere or in a collision.

        They have room around them (`room_checker`), and each joint has the whole turns that bring it nearest to the start.
        On the straight way from the start to the nearest one there is no collision, unless there is one on the ways to all
        that were tried: nearer ones are left out.

        Args:
            position: of the end effector in the world (N, 3), m.
            quaternion: its orientation (N, 4), [w, x, y, z]; not read without orientations.
            start: from where the arms begin (N, J), rad (m).
        """
        q = self._search(position, quaternion)
        q = nearest_turns(self._robot, q, start[:, None])
        for own, begin in zip(q, start, strict=True):
            own[self._blocked(own, begin)] = np.inf
        return q

    def _blocked(self, q: Floats, start: Floats) -> list[int]:
        """Which configurations (K, J) are nearer than the first one with a free straight way from the start (J,)."""
        farthest = np.abs(q - start).max(axis=1)
        nearer: list[int] = []
        for index in np.argsort(farthest)[:_WAYS].tolist():
            if not np.isfinite(farthest[index]):
                break
            if not self._free.check(straight_move(start, q[index])).any():
                return nearer
            nearer.append(index)
        return []

    def _search(self, position: Floats, quaternion: Floats | None) -> Floats:
        if quaternion is None:
            quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (len(position), 1))
        q = np.tile(self._starts, (len(position), 1))
        aim = np.repeat(position, STARTS, axis=0)
        turned = np.repeat(rotations.to_matrix(quaternion), STARTS, axis=0)
        for _ in range(_STEPS):
            error, jacobian = self._look(q, aim, turned)
            across = jacobian.transpose(0, 2, 1)
            damping = _DAMPING * np.minimum(np.abs(error).max(axis=1), 1.0)
            gram = jacobian @ across + (damping[:, None, None] + 1e-9) * np.eye(self._rows)
            step = (across @ np.linalg.solve(gram, error[..., None]))[..., 0]
            step /= np.maximum(np.abs(step).max(axis=1, keepdims=True) / _LONGEST, 1.0)
            q = np.clip(q + step, self._low, self._high)
        found = np.abs(self._look(q, aim, turned)[0]).max(axis=1) < _REACHED
        reached = np.flatnonzero(found)
        if len(reached):
            found[reached] = ~self._with_room.check(q[reached])
        q[~found] = np.inf
        return q.reshape(len(position), STARTS, -1)

    def _look(self, q: Floats, position: Floats, rotation: Floats) -> tuple[Floats, Floats]:
        """The errors (M, K), m, and the Jacobians (M, K, J) of configurations q (M, J)."""
        frames = self._kinematics.joint_frames(q)
        jacobian = frames.jacobian[:, : self._rows]
        away = position - frames.position
        if self._rows == 3:
            return away, jacobian
        turn = rotations.to_vector(
            rotations.from_matrix(rotation @ frames.rotation.transpose(0, 2, 1))
        )
        scale = np.array([1.0] * 3 + [_LENGTH] * 3)[:, None]
        return np.concatenate([away, _LENGTH * turn], axis=1), jacobian * scale
