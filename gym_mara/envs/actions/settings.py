"""The keyword arguments that choose what an action means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_mara.errors import GymMaraError, finite_numbers, one_of, positive_number

ACTIONS = ("absolute", "relative", "cartesian")
REFERENCES = ("position", "target")
_LARGEST_SCALE = 100.0


@dataclass(frozen=True)
class ActionSettings:
    """What an action means; each value is a keyword argument of the environments.

    Raises:
        GymMaraError: a name is unknown, or a scale is out of its range.
    """

    action: str | None = None
    """The action mode: "absolute" for joint targets, "relative" for a step of each joint, or "cartesian" for a twist of the
    tool; None for the task's own."""
    action_scale: float | Sequence[float] | None = None
    """What the action 1 means. Relative: a step, rad (m for a prismatic joint); None for the smallest one
    with which the joint moves at its velocity limit. Cartesian: a velocity, m/s and rad/s; None for 0.4 m/s and 0.8 rad/s. One
    number, or one for each entry of the action."""
    action_from: str = "position"
    """Where a step begins: at the "position" of the joints, as the sensors see it, or at their last "target"."""

    def __post_init__(self) -> None:
        if self.action is not None:
            one_of("action", self.action, ACTIONS)
        one_of("action_from", self.action_from, REFERENCES)
        scale = self.action_scale
        if scale is None:
            return
        if isinstance(scale, (list, tuple)) or (isinstance(scale, np.ndarray) and scale.ndim):
            numbers = finite_numbers("action_scale", scale)
            if not any(numbers):
                raise GymMaraError(
                    f"action_scale must have a number that is not zero, not {numbers}"
                )
            checked = tuple(_checked(number, or_zero=True) for number in numbers)
            object.__setattr__(self, "action_scale", checked)
        else:
            object.__setattr__(self, "action_scale", _checked(scale))


def _checked(scale: object, *, or_zero: bool = False) -> float:
    return positive_number(
        "action_scale",
        scale,
        or_zero=or_zero,
        at_most=_LARGEST_SCALE,
        reason="no arm moves so far in a control period, nor at such a velocity",
    )
