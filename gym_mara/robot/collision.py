"""Does an arm collide at these configurations? One small interface, two engines."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara.errors import unknown
from gym_mara.robot.model import RobotModel


class CollisionChecker(ABC):
    """Checks the pairs of links that may collide, the scene's links among them."""

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot

    @abstractmethod
    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether any pair touches, (N,), at each of the configurations q (N, J), rad."""

    def __reduce__(self) -> tuple[Any, ...]:
        # Engines' objects do not pickle; the robot says it all.
        return type(self), (self.robot,)

    def __deepcopy__(self, memo: dict[int, Any]) -> CollisionChecker:
        return type(self)(self.robot)


def make_checker(name: str, robot: RobotModel) -> CollisionChecker:
    """The checker of this name, "coal" or "fcl".

    Raises:
        GymMaraError: the name is neither.
        MissingExtraError: the engine is not installed.
    """
    if name == "coal":
        return CoalChecker(robot)
    if name == "fcl":
        from gym_mara.robot.fcl import FclChecker

        return FclChecker(robot)
    raise unknown("collision engine", name, ("coal", "fcl"))


class CoalChecker(CollisionChecker):
    """Coal, FCL's successor that Pinocchio ships, with a broad phase per thread."""

    # Below this many configurations the threads cost more than they save.
    _PARALLEL_FROM = 8

    def __init__(self, robot: RobotModel) -> None:
        super().__init__(robot)
        # For one configuration at a time: an arm has too few bodies for a tree of their boxes to pay.
        self._data = robot.model.createData()
        self._naive = pin.BroadPhaseManager_NaiveCollisionManager(
            robot.model, robot.geometry, robot.geometry.createData()
        )
        # For many: the only broad phase that Pinocchio spreads over threads.
        self._threads = available_cpus()
        self._pool = pin.BroadPhaseManagerPool_DynamicAABBTreeCollisionManager(
            robot.model, robot.geometry, self._threads
        )

    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        if len(q) < self._PARALLEL_FROM:
            model, data, naive = self.robot.model, self._data, self._naive
            return np.array([pin.computeCollisions(model, data, naive, row, True) for row in q])
        result = pin.computeCollisionsInParallel(self._threads, self._pool, q.T, True, False)
        return np.asarray(result, dtype=np.bool_).reshape(len(q))


def available_cpus() -> int:
    """The number of processors that this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on every system
        return os.cpu_count() or 1
