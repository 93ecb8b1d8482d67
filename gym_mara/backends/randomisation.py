"""Domain randomisation: ranges of physical parameters, from which each arm draws new values for every episode."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from gym_mara.errors import LARGEST, SMALLEST, GymMaraError, finite_numbers, unknown
from gym_mara.robot import RobotModel
from gym_mara.types import Floats


class _Parameter(NamedTuple):
    nominal: float
    per_joint: bool = False
    positive: bool = False


# Scales have no unit. The mass of a joint is that of the links between it and the next joint.
PARAMETERS = {
    "mass": _Parameter(1.0, per_joint=True, positive=True),  # scale of mass and inertia
    "effort_limit": _Parameter(1.0, per_joint=True, positive=True),  # scale
    "servo_gain": _Parameter(1.0, per_joint=True, positive=True),  # scale
    "joint_friction": _Parameter(0.0, per_joint=True),  # Coulomb friction, Nm
    "contact_friction": _Parameter(1.0),  # coefficient
    "latency": _Parameter(0.0),  # s, from a command to its effect
    "sensor_noise": _Parameter(0.0),  # standard deviation of each measured joint position, rad
}


class Randomisation:
    """Uniform distributions of an arm's parameters.

    Args:
        ranges: name → (lowest, highest); the names are those of PARAMETERS.
        robot: the arm.

    Raises:
        GymMaraError: a name is unknown, or a range is not (lowest, highest) or not within its bounds.
    """

    def __init__(self, ranges: Mapping[str, Sequence[float]], robot: RobotModel) -> None:
        if not isinstance(ranges, Mapping):
            raise GymMaraError(
                f"randomisation must map names to (lowest, highest), not be {ranges!r}; "
                f"the names: {', '.join(sorted(PARAMETERS))}"
            )
        self.ranges = {name: _checked(name, ends) for name, ends in sorted(ranges.items())}
        self._num_joints = robot.num_joints

    def draw(self, seed: int) -> dict[str, Floats]:
        """Random parameters of one arm: (J,) for those of each joint, else ()."""
        generator = np.random.default_rng(seed)
        return {
            name: generator.uniform(*self.ranges[name], self._size(name)) for name in self.ranges
        }

    def nominal(self) -> dict[str, Floats]:
        """The same parameters before the first episode: those of the robot."""
        return {name: np.full(self._size(name), PARAMETERS[name].nominal) for name in self.ranges}

    def _size(self, name: str) -> tuple[int, ...]:
        return (self._num_joints,) if PARAMETERS[name].per_joint else ()


def _checked(name: str, ends: Any) -> tuple[float, float]:
    if name not in PARAMETERS:
        raise unknown("parameter of randomisation", name, PARAMETERS)
    positive = PARAMETERS[name].positive
    try:
        low, high = finite_numbers(name, ends, 2)
    except GymMaraError:
        low = high = np.nan
    if not 0.0 <= low <= high or (positive and low < SMALLEST):
        raise GymMaraError(
            f"randomisation of {name!r} must be (lowest, highest), in this order, finite and "
            f"{f'at least {SMALLEST:g}' if positive else 'not negative'}, at most {LARGEST:g}; not {ends!r}"
        )
    return low, high
