"""The reward of ROS2Learn's MARA environments as pure functions of arrays.

Source: gym-gazebo2 (arXiv 1903.06278); its constants are the defaults of `gym_mara.tasks.reach.ReachTask`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def distance_reward(distance: Floats, alpha: float, kappa: float) -> Floats:
    """From 11 at the target down to 0 at 1 m: a wide basin and a peak of height 10.

    (e^(-α d) - e^(-α)) / (1 - e^(-α)) + 10 (e^(-α d/κ) - e^(-α/κ)) / (1 - e^(-α/κ)) of d (...,), m.
    """
    return _decay(distance, alpha) + 10.0 * _decay(distance, alpha / kappa)


def orientation_factor(angle: Floats, beta: float, gamma: float) -> Floats:
    """From 1 at angle 0 down to γ / (1 + γ) at π: (1 - (θ/π)^β + γ) / (1 + γ) of θ (...,), rad."""
    return (1.0 - (angle / np.pi) ** beta + gamma) / (1.0 + gamma)


def collision_penalty(
    collided: NDArray[np.bool_], distance: Floats, delta: float, eta: float
) -> Floats:
    """δ (2 min(d, 0.5))^η on a collision, else 0, of d (...,), m."""
    return np.where(collided, delta * (2.0 * np.minimum(distance, 0.5)) ** eta, 0.0)


def _decay(distance: Floats, rate: float) -> Floats:
    """An exponential from 1 at 0 m to 0 at 1 m."""
    end = np.exp(-rate)
    return (np.exp(-rate * distance) - end) / (1.0 - end)
