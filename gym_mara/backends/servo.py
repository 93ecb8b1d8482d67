"""The position servo of a joint, planned ahead: where it lets the joint be at each moment of a control period."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.errors import GymMaraError

Floats = NDArray[np.float64]


def step_times(control_period: float, physics_step: float) -> Floats:
    """The moments (S + 1,), s, between which the S physics steps of a control period lie, the first 0.

    Raises:
        GymMaraError: a control period is no whole number of physics steps.
    """
    steps = round(control_period / physics_step)
    if steps < 1 or abs(steps * physics_step - control_period) > 1e-9:
        raise GymMaraError(
            f"physics_step {physics_step} s must divide the control period, {control_period} s, "
            f"as {control_period / max(steps, 1):g} s does"
        )
    return physics_step * np.arange(steps + 1, dtype=np.float64)


def servo_motion(
    q: Floats, q_target: Floats, gain: Floats, velocity_limit: Floats, time: NDArray[Any]
) -> Floats:
    """How far joints have moved at `time` under the law q̇ = clip(gain · (q_target - q), ±velocity_limit).

    At full velocity up to the point where the law asks for less, then exponentially: it never overshoots.

    Args:
        q, q_target: positions now and wanted (..., J), rad.
        gain: 1/s, (..., J).
        velocity_limit: rad/s, (..., J).
        time: since now, s; broadcasts against the others.

    Returns:
        The displacements, rad, of the broadcast shape.
    """
    way = q_target - q
    slow_zone = velocity_limit / gain  # within this distance the law asks for less than the limit
    distance = np.abs(way)
    slow_way = np.minimum(distance, slow_zone)
    fast_time = (distance - slow_way) / velocity_limit
    fast = np.minimum(time, fast_time)
    slow = slow_way * np.expm1(gain * (fast - time))
    return np.copysign(fast * velocity_limit - slow, way)
