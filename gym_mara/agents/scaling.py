"""Maps the actions of a policy onto joint targets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike

from gym_mara.types import Floats


@dataclass(frozen=True, eq=False)
class Scaling:
    """The linear map from a box of actions onto the action space of an environment, as `RescaleAction` has it."""

    low: Floats
    """The lowest actions of the environment (J,), rad."""
    high: Floats
    """The highest actions of the environment (J,), rad."""
    space: Box
    """The actions (J,)."""

    def __post_init__(self) -> None:
        lowest = self.space.low.astype(np.float64)
        span = (self.high - self.low) / (self.space.high.astype(np.float64) - lowest)
        object.__setattr__(self, "_lowest", lowest)
        object.__setattr__(self, "_span", span)

    def targets(self, actions: ArrayLike) -> Floats:
        """The joint targets (…, J), rad, of actions (…, J)."""
        return self.low + self._span * (np.asarray(actions, np.float64) - self._lowest)  # type: ignore[attr-defined,no-any-return]


def unit_box(joints: int) -> Box:
    """The actions in [-1, 1] of an arm with J joints."""
    return Box(-1.0, 1.0, (joints,), np.float32)


def is_unit_box(space: object) -> bool:
    """Whether a space is a box of actions in [-1, 1]."""
    return isinstance(space, Box) and bool(np.all(space.low == -1.0) and np.all(space.high == 1.0))
