"""The contract of a collision checker, and the checker that sees no collision."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.robot import RobotModel


class CollisionChecker(ABC):
    """Checks the pairs of links that may collide, the scene's links among them."""

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot

    @abstractmethod
    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether any pair touches, (N,), at each of the configurations q (N, J), rad."""

    def with_room(self, displacement: NDArray[np.float64]) -> CollisionChecker | None:
        """A checker for which pairs touch already that could meet while no joint moves further than `displacement` (J,), rad.

        None where the engine cannot tell.
        """
        return None

    def __reduce__(self) -> tuple[Any, ...]:
        # Engines' objects do not pickle; the robot says it all.
        return type(self), (self.robot,)

    def __deepcopy__(self, memo: dict[int, Any]) -> CollisionChecker:
        make, arguments = self.__reduce__()
        copied: CollisionChecker = make(*arguments)
        return copied


class NoChecker(CollisionChecker):
    """Sees no collision, and costs nothing."""

    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.zeros(len(q), dtype=np.bool_)

    def with_room(self, displacement: NDArray[np.float64]) -> CollisionChecker:
        return self
