"""Whether an arm has room at a configuration: nothing collides if its joints turn a little."""

from __future__ import annotations

import numpy as np

from gym_mara.collision.base import CollisionChecker
from gym_mara.collision.coal import CoalChecker
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.types import Floats, Mask

ROOM = 0.02
"""How far each joint can turn without a collision where an arm has room, rad (m)."""
_SAMPLES = 1000
"""The random configurations that decide how the room of an arm is judged."""


def room_checker(robot: RobotModel) -> CollisionChecker:
    """A checker that reports configurations without room.

    In general it is the check with a margin: quick, and certain that there is no collision while no joint moves by more than ROOM.
    But its margin of a pair of links is for the farthest point of the arm. Some arms never have so much, because two of their
    links are always near each other. An arm without it at _SAMPLES random configurations, which are always the same, has a
    `MovedChecker`.
    """
    margin = CoalChecker(robot, np.full(robot.num_joints, ROOM))
    generator, (low, high) = np.random.default_rng(0), reachable_range(robot)
    for _ in range(_SAMPLES):
        if not margin.check(generator.uniform(low, high)[None])[0]:
            return margin
    return MovedChecker(robot)


class MovedChecker(CollisionChecker):
    """Checks each configuration exactly, and those with every joint moved by ROOM, but not beyond its limits.

    Any three joints are moved in all combinations of directions. These are fewer than 4 J moves, not all 2^J.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        super().__init__(robot)
        self._exact = CoalChecker(robot)
        self._moves = ROOM * np.vstack([np.zeros(robot.num_joints), _directions(robot.num_joints)])

    def check(self, q: Floats) -> Mask:
        blocked = np.zeros(len(q), dtype=np.bool_)
        for move in self._moves:
            left = np.flatnonzero(~blocked)
            moved = np.clip(q[left] + move, self.robot.lower, self.robot.upper)
            blocked[left] = self._exact.check(moved)
        return blocked


def _directions(joints: int) -> Floats:
    """Signs (M, J), of which any three columns have all combinations: Hadamard's matrix and its negative, an orthogonal array."""
    signs = np.ones((1, 1))
    while len(signs) < joints:
        signs = np.block([[signs, signs], [signs, -signs]])
    return np.vstack([signs, -signs])[:, :joints]
