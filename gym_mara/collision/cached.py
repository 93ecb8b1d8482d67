"""A collision checker for large batches: it skips arms that certainly do not collide, or certainly do."""

from __future__ import annotations

from typing import Any

import numpy as np

from gym_mara.collision.base import CollisionChecker
from gym_mara.collision.coal import CoalChecker, ParallelCoalChecker
from gym_mara.collision.overlaps import Overlaps
from gym_mara.robot import RobotModel
from gym_mara.types import Floats, Mask


class CachedChecker(CollisionChecker):
    """Gives the same answers as the exact checker, with fewer checks.

    Each arm must always be in the same row. If nothing can collide while no joint moves by more than RADIUS from a
    configuration, the arm is not checked again while its joints stay that close to it. This saves most checks once a
    policy has learnt to hold a pose. And where many arms collide, as while a policy explores, `Overlaps` finds most of them.

    Args:
        robot: the arm.
        exact: checks the other arms.
    """

    RADIUS = 0.01
    """rad (m for a prismatic joint)."""
    MANY = 64
    """`Overlaps` is used if at least so many arms collided in the last step."""

    def __init__(self, robot: RobotModel, exact: CoalChecker | ParallelCoalChecker) -> None:
        super().__init__(robot)
        self._exact = exact
        self._with_margin = CoalChecker(robot, np.full(robot.num_joints, self.RADIUS))
        # For each arm: its last configuration, the last one checked with the margin, and the one known to be free all
        # around. NaN is near nothing.
        self._last: Floats = np.empty((0, robot.num_joints))
        self._tested = self._free = self._last
        self._any_free = False
        self._collisions = 0  # in the last step
        self._overlaps: Overlaps | None = None  # made when first needed

    def check(self, q: Floats) -> Mask:
        if len(q) != len(self._last):
            self._last = np.full(q.shape, np.nan)
            self._tested, self._free = self._last.copy(), self._last.copy()
            self._any_free = False
        collided = np.zeros(len(q), dtype=np.bool_)
        unsure = ~self._near(q, self._free) if self._any_free else ~collided
        if unsure.any():
            self._check_exactly(q, unsure, collided)
            # The check with the margin pays only for arms that stay in place, and once in each place.
            stays = unsure & ~collided & self._near(q, self._last)
            if np.count_nonzero(stays):
                self._look_around(q, stays)
        self._last, self._collisions = q.copy(), int(np.count_nonzero(collided))
        return collided

    def _check_exactly(self, q: Floats, unsure: Mask, collided: Mask) -> None:
        """Enter which of the unsure arms collide."""
        if self._collisions >= self.MANY:
            if self._overlaps is None:
                self._overlaps = Overlaps(self.robot)
            if self._overlaps:
                np.logical_and(self._overlaps.find(q), unsure, out=collided)
        rest = unsure & ~collided
        collided[rest] = self._exact.check(q[rest])

    def _look_around(self, q: Floats, stays: Mask) -> None:
        """Check with the margin those arms that stay in place and were not tested there."""
        test = np.flatnonzero(stays & ~self._near(q, self._tested))
        if len(test):
            self._tested[test] = q[test]
            free = test[~self._with_margin.check(q[test])]
            self._free[free] = q[free]
            self._any_free |= len(free) > 0

    def _near(self, q: Floats, other: Floats) -> Mask:
        return np.asarray((np.abs(q - other) <= self.RADIUS).all(axis=1))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self._exact)
