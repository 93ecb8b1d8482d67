"""A checker that skips the checks of arms that have stayed where nothing is near."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.collision.base import CollisionChecker
from gym_mara.collision.coal import CoalChecker, ParallelCoalChecker
from gym_mara.robot import RobotModel


class CachedChecker(CollisionChecker):
    """Spares the checks of arms that stay where there is known to be room around them; the answers are the same.

    For many arms, each always in the same row, as a policy keeps them that has learnt where to go: where nothing can touch
    while no joint moves further than NEARBY, nothing needs to be checked while none does.

    Args:
        robot: the arm.
        exact: what checks the others.
    """

    NEARBY = 0.01
    """rad (m for a prismatic joint)."""

    def __init__(self, robot: RobotModel, exact: CoalChecker | ParallelCoalChecker) -> None:
        super().__init__(robot)
        self._exact = exact
        self._with_room = CoalChecker(robot, np.full(robot.num_joints, self.NEARBY))
        # Per arm: where it was last, where it was last looked for room, and where room was found; NaN is near nothing.
        self._last: NDArray[np.float64] = np.empty((0, robot.num_joints))
        self._looked = self._free = self._last

    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        if len(q) != len(self._last):
            self._last = np.full(q.shape, np.nan)
            self._looked, self._free = self._last.copy(), self._last.copy()
        collided = np.zeros(len(q), dtype=np.bool_)
        unsure = ~self._near(q, self._free)
        if unsure.any():
            collided[unsure] = self._exact.check(q[unsure])
            # Only arms that stay about are worth a look, and only one look at each place.
            stays = unsure & ~collided & self._near(q, self._last)
            look = np.flatnonzero(stays & ~self._near(q, self._looked))
            if len(look):
                self._looked[look] = q[look]
                roomy = look[~self._with_room.check(q[look])]
                self._free[roomy] = q[roomy]
        self._last = q.copy()
        return collided

    def _near(self, q: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray((np.abs(q - place) <= self.NEARBY).all(axis=1))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self._exact)
