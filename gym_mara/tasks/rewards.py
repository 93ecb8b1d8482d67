"""The terms of rewards, as pure functions of arrays of NumPy or torch.

Those of ROS2Learn's MARA environments come from gym-gazebo2 (arXiv 1903.06278). Its constants are the default values of
`gym_mara.tasks.reach.ReachTask`.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from gym_mara.arrays import Constants, namespace
from gym_mara.types import Floats, Mask


def distance_reward(distance: Floats, alpha: float, kappa: float) -> Floats:
    """The distance reward: 11 at the target and 0 at 1 m, the sum of a wide basin and a narrow peak of height 10.

    (e^(-α d) - e^(-α)) / (1 - e^(-α)) + 10 (e^(-α d/κ) - e^(-α/κ)) / (1 - e^(-α/κ)) for a distance d (...,), m.
    """
    # Each summand is an exponential, scaled and shifted so that it falls from its height at 0 m to 0 at 1 m.
    xp, basin, wide, peak, narrow, shift = _basin_and_peak(alpha, kappa).like(distance)
    return basin * xp.exp(wide * distance) + peak * xp.exp(narrow * distance) - shift


@lru_cache(maxsize=64)
def _basin_and_peak(alpha: float, kappa: float) -> Constants:
    """The scale and the exponent of each summand, and the sum of their shifts."""
    narrow = alpha / kappa
    basin, peak = 1.0 / -math.expm1(-alpha), 10.0 / -math.expm1(-narrow)
    shift = basin * math.exp(-alpha) + peak * math.exp(-narrow)
    return Constants(basin, -alpha, peak, -narrow, shift)


def orientation_factor(angle: Floats, beta: float, gamma: float) -> Floats:
    """The orientation factor: 1 at angle 0 and γ / (1 + γ) at angle π.

    (1 - (θ/π)^β + γ) / (1 + γ) for an angle θ (...,), rad.
    """
    _, one, exponent, scale = _orientation_constants(beta, gamma).like(angle)
    return one - scale * angle**exponent


@lru_cache(maxsize=64)
def _orientation_constants(beta: float, gamma: float) -> Constants:
    return Constants(1.0, beta, np.pi**-beta / (1.0 + gamma))


def collision_penalty(collided: Mask, distance: Floats, delta: float, eta: float) -> Floats:
    """The collision penalty: δ (2 min(d, 0.5))^η at a distance d (...,), m, if the arm collided, else 0."""
    xp = namespace(distance)
    count = np.count_nonzero(collided) if xp is np else None  # a GPU would wait for it
    if count == 0:
        return np.zeros(distance.shape)
    _, one, two, size, exponent = _penalty_constants(delta, eta).like(distance)
    penalty = size * xp.minimum(two * distance, one) ** exponent
    return penalty if count == collided.size else collided * penalty


@lru_cache(maxsize=64)
def _penalty_constants(delta: float, eta: float) -> Constants:
    return Constants(1.0, 2.0, delta, eta)


_CLOSENESS = Constants([0.3, 0.25, 0.25, 0.2], [-1 / 0.3, -1 / 0.03, -1 / 0.003, -1 / 0.0005], 0.2)


def closeness(error: Floats) -> Floats:
    """The reward for any target: 1 with no error, with a slope at every scale, for an error E (...,), m.

    0.3 e^(-E/0.3) + 0.25 e^(-E/0.03) + 0.25 e^(-E/0.003) + 0.2 e^(-E/0.0005) - 0.2 E.
    """
    xp, heights, exponents, slope = _CLOSENESS.like(error)
    return xp.sum(heights * xp.exp(error[..., None] * exponents), axis=-1) - slope * error
