"""End-effector poses that an arm can take without a collision: random ones, and a fixed one for each robot."""

from __future__ import annotations

import math

import numpy as np

from gym_mara.collision.base import CollisionChecker
from gym_mara.collision.coal import CoalChecker
from gym_mara.collision.room import ROOM, room_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.types import Floats

_TRIES = 10_000
_STEP = 0.05
"""How far a joint moves at most between two checks of a move, rad (m)."""
_FARTHEST = 1000.0
"""How far a joint moves at most in a move that is checked, rad (m)."""


class FreePoses:
    """Draws end-effector poses from the arm's collision-free configurations.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._checker = CoalChecker(robot)
        self._with_room = room_checker(robot)
        self._kinematics = robot.kinematics()
        self._low, self._high = reachable_range(robot)

    def draw(self, generator: np.random.Generator) -> tuple[Floats, Floats]:
        """Position (3,), m, and quaternion (4,), [w, x, y, z], at a configuration drawn uniformly from all free ones.

        Raises:
            GymMaraError: none of many random configurations is free.
        """
        return self._pose(self._free_configuration(generator, self._checker))

    def draw_move(
        self, generator: np.random.Generator, start: Floats | None = None
    ) -> tuple[Floats, Floats, Floats]:
        """A start (J,), rad, unless it is given, and a pose to which a free joint move leads.

        Both configurations are drawn uniformly from those with room around them (`room_checker`).

        Returns:
            The start; and the pose, position (3,), m, and quaternion (4,), [w, x, y, z], of another configuration. No collision
            is on the straight joint move from the one to the other, checked every _STEP.

        Raises:
            GymMaraError: no free configuration, or none with room or with a free move, is found; or a joint's range is so large
                that moves are too long to check.
        """
        _check_length(self._high - self._low)
        for _ in range(_TRIES):
            begin = start
            if begin is None:
                begin = self._free_configuration(generator, self._with_room)
            end = self._free_configuration(generator, self._with_room)
            if not self._checker.check(straight_move(begin, end)).any():
                return begin, *self._pose(end)
        raise GymMaraError(
            f"{self._robot.name} collides on all of {_TRIES} random joint moves"
            + ("" if start is None else f" from {start.tolist()}: choose another start_q")
        )

    def _pose(self, q: Floats) -> tuple[Floats, Floats]:
        position, quaternion = self._kinematics.pose(q[None])
        return position[0], quaternion[0]

    def _free_configuration(
        self, generator: np.random.Generator, checker: CollisionChecker
    ) -> Floats:
        for _ in range(_TRIES):
            q = generator.uniform(self._low, self._high)
            if not checker.check(q[None])[0]:
                return q
        raise GymMaraError(self._why_none(exact=checker is self._checker))

    def _why_none(self, exact: bool) -> str:
        name, free = self._robot.name, 0.0
        if not exact:
            q = np.random.default_rng(0).uniform(self._low, self._high, (_TRIES, len(self._low)))
            free = float(np.mean(~self._checker.check(q)))
        if free > 0.0:
            return (
                f"{name} is free at {100.0 * free:.3g} % of random configurations, but has room at none of {_TRIES}: something "
                f"collides if its joints move by {ROOM} rad (m); disable pairs of links that never touch in its SRDF"
            )
        return (
            f"{name} collides at all of {_TRIES} random configurations; "
            "check which pairs of links its SRDF disables"
        )


def straight_move(begin: Floats, end: Floats) -> Floats:
    """The configurations before the end of a straight joint move (K, J), at most _STEP apart; the first one if it ends there.

    Raises:
        GymMaraError: a joint moves by more than _FARTHEST.
    """
    way = end - begin
    _check_length(way)
    count = max(1, math.ceil(float(np.abs(way).max()) / _STEP))
    return begin + np.linspace(0.0, 1.0, count + 1)[:-1, None] * way


def _check_length(way: Floats) -> None:
    joint = int(np.abs(way).argmax())
    if abs(way[joint]) > _FARTHEST:
        raise GymMaraError(
            f"joint {joint}, counted from 0, can move by {abs(way[joint]):g} rad (m), and a straight joint move is checked for "
            f"collisions up to {_FARTHEST:g}: give the joint its true limits in the URDF"
        )


def reachable_pose(robot: RobotModel) -> tuple[Floats, Floats]:
    """The end-effector pose, position (3,), m, and quaternion (4,), [w, x, y, z], of a collision-free configuration.

    Always the same for a robot: the first of a fixed sequence, in the middle half of the joints' ranges, that is free
    and moves the tool away from home. The home pose where there is none.
    """
    low, high = reachable_range(robot)
    rng = np.random.default_rng(0)
    candidates = rng.uniform(0.75 * low + 0.25 * high, 0.25 * low + 0.75 * high, (256, len(low)))
    candidates = np.vstack([candidates, robot.home])
    position, quaternion = robot.kinematics().pose(candidates)
    away = np.linalg.norm(position - position[-1], axis=1)
    good = ~CoalChecker(robot).check(candidates) & (away > 0.25 * away.max())
    chosen = int(good.argmax()) if good.any() else len(candidates) - 1
    return position[chosen], quaternion[chosen]
