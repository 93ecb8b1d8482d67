"""The reward terms of ROS2Learn's MARA environments, as pure functions of arrays.

Source: gym-gazebo2 (arXiv 1903.06278). Its constants are the default values of `gym_mara.tasks.reach.ReachTask`.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from gym_mara.types import Floats, Mask

# Arrays, because a NumPy ufunc on one row takes twice as long with a Python number.
_ONE, _TWO = np.array(1.0), np.array(2.0)


def distance_reward(distance: Floats, alpha: float, kappa: float) -> Floats:
    """The distance reward: 11 at the target and 0 at 1 m, the sum of a wide basin and a narrow peak of height 10.

    (e^(-α d) - e^(-α)) / (1 - e^(-α)) + 10 (e^(-α d/κ) - e^(-α/κ)) / (1 - e^(-α/κ)) for a distance d (...,), m.
    """
    # Each summand is an exponential, scaled and shifted so that it falls from its height at 0 m to 0 at 1 m.
    (basin, wide), (peak, narrow), shift = _basin_and_peak(alpha, kappa)
    return basin * np.exp(wide * distance) + peak * np.exp(narrow * distance) - shift


@lru_cache(maxsize=64)
def _basin_and_peak(
    alpha: float, kappa: float
) -> tuple[tuple[Floats, Floats], tuple[Floats, Floats], Floats]:
    """The scale and the exponent of each summand, and the sum of their shifts."""
    narrow = alpha / kappa
    basin, peak = 1.0 / -math.expm1(-alpha), 10.0 / -math.expm1(-narrow)
    shift = basin * math.exp(-alpha) + peak * math.exp(-narrow)
    return (
        (np.array(basin), np.array(-alpha)),
        (np.array(peak), np.array(-narrow)),
        np.array(shift),
    )


def orientation_factor(angle: Floats, beta: float, gamma: float) -> Floats:
    """The orientation factor: 1 at angle 0 and γ / (1 + γ) at angle π.

    (1 - (θ/π)^β + γ) / (1 + γ) for an angle θ (...,), rad.
    """
    exponent, scale = _orientation_constants(beta, gamma)
    return _ONE - scale * angle**exponent


@lru_cache(maxsize=64)
def _orientation_constants(beta: float, gamma: float) -> tuple[Floats, Floats]:
    return np.array(beta), np.array(np.pi**-beta / (1.0 + gamma))


def collision_penalty(collided: Mask, distance: Floats, delta: float, eta: float) -> Floats:
    """The collision penalty: δ (2 min(d, 0.5))^η at a distance d (...,), m, if the arm collided, else 0."""
    count = np.count_nonzero(collided)
    if not count:
        return np.zeros(np.shape(distance))
    size, exponent = _penalty_constants(delta, eta)
    penalty = size * np.minimum(_TWO * distance, _ONE) ** exponent
    return penalty if count == collided.size else collided * penalty


@lru_cache(maxsize=64)
def _penalty_constants(delta: float, eta: float) -> tuple[Floats, Floats]:
    return np.array(delta), np.array(eta)
