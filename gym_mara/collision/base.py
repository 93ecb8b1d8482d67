"""The contract of a collision checker, and the checker that finds no collision."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np

from gym_mara.robot import RobotModel
from gym_mara.types import Floats, Mask


class CollisionChecker(ABC):
    """Checks a robot's collision pairs, which include the fixed links around the arm.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot

    @abstractmethod
    def check(self, q: Floats) -> Mask:
        """Whether any pair collides (N,), at each of the configurations q (N, J), rad."""

    def with_margin(self, displacement: Floats) -> CollisionChecker | None:
        """A checker that reports pairs that could meet while no joint moves by more than `displacement` (J,), rad.

        None if the engine has no such checker.
        """
        return None

    def __reduce__(self) -> tuple[Any, ...]:
        # The engines' objects do not pickle; a copy is built from the robot.
        return type(self), (self.robot,)

    def __deepcopy__(self, memo: dict[int, Any]) -> CollisionChecker:
        make, arguments = self.__reduce__()
        copied: CollisionChecker = make(*arguments)
        return copied


class NoChecker(CollisionChecker):
    """Finds no collision, at no cost."""

    def check(self, q: Floats) -> Mask:
        return np.zeros(len(q), dtype=np.bool_)

    def with_margin(self, displacement: Floats) -> CollisionChecker:
        return self
