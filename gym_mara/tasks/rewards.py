"""The reward of ROS2Learn's MARA environments as pure functions of arrays.

Source: gym-gazebo2 (arXiv 1903.06278); its constants are the defaults of `gym_mara.tasks.reach.ReachTask`.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def distance_reward(distance: Floats, alpha: float, kappa: float) -> Floats:
    """From 11 at the target down to 0 at 1 m: a wide basin and a peak of height 10.

    (e^(-α d) - e^(-α)) / (1 - e^(-α)) + 10 (e^(-α d/κ) - e^(-α/κ)) / (1 - e^(-α/κ)) of d (...,), m.
    """
    # Each summand is an exponential, scaled and shifted to go from its height at 0 m to 0 at 1 m.
    basin, peak = _decay(alpha, 1.0), _decay(alpha / kappa, 10.0)
    wide = basin.scale * np.exp(-basin.rate * distance)
    return wide + peak.scale * np.exp(-peak.rate * distance) - (basin.shift + peak.shift)


class _Decay(NamedTuple):
    rate: float
    scale: float
    shift: float


@lru_cache(maxsize=64)
def _decay(rate: float, height: float) -> _Decay:
    scale = height / -math.expm1(-rate)
    return _Decay(rate, scale, scale * math.exp(-rate))


def orientation_factor(angle: Floats, beta: float, gamma: float) -> Floats:
    """From 1 at angle 0 down to γ / (1 + γ) at π: (1 - (θ/π)^β + γ) / (1 + γ) of θ (...,), rad."""
    return 1.0 - angle**beta * (np.pi**-beta / (1.0 + gamma))


def collision_penalty(
    collided: NDArray[np.bool_], distance: Floats, delta: float, eta: float
) -> Floats:
    """δ (2 min(d, 0.5))^η on a collision, else 0, of d (...,), m."""
    if not np.count_nonzero(collided):
        return np.zeros(np.shape(distance))
    return collided * (delta * np.minimum(2.0 * distance, 1.0) ** eta)
