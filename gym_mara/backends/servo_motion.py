"""The law of the position servos: paths planned one control period ahead, and when a state has diverged."""

from __future__ import annotations

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.types import Floats, Mask

DIVERGED_VELOCITY = 1e3
"""A joint this many times as fast as its limit has diverged."""
MOST_PHYSICS_STEPS = 10_000
"""The largest number of physics steps in a control period."""


def has_diverged(q: Floats, qd: Floats, velocity_limit: Floats) -> Mask:
    """Which arms have a state, q and q̇ (..., J), that is not finite or is far beyond the velocity limits (J,)."""
    sane = np.isfinite(q) & (np.abs(qd) < DIVERGED_VELOCITY * velocity_limit)
    if np.count_nonzero(sane) == sane.size:
        return np.zeros(sane.shape[:-1], np.bool_)
    return np.logical_not(np.logical_and.reduce(sane, axis=-1))


def step_times(control_period: float, physics_step: float) -> Floats:
    """The times between the physics steps of a control period, from 0 to the period (K + 1,), s.

    Raises:
        GymMaraError: a control period is not a whole number of physics steps, or has too many.
    """
    if control_period / physics_step > MOST_PHYSICS_STEPS:
        raise GymMaraError(
            f"a control period of {control_period:g} s must have at most {MOST_PHYSICS_STEPS} physics steps, because a step "
            f"of the environment computes them all; with physics_step {physics_step:g} s it has {control_period / physics_step:g}"
        )
    steps = round(control_period / physics_step)
    if steps < 1 or abs(steps * physics_step - control_period) > 1e-9:
        raise GymMaraError(
            f"physics_step {physics_step} s must divide the control period, {control_period} s, "
            f"as {control_period / max(steps, 1):g} s does"
        )
    return physics_step * np.arange(steps + 1, dtype=np.float64)


def servo_motion(
    q: Floats, q_target: Floats, gain: Floats, velocity_limit: Floats, time: Floats
) -> Floats:
    """How far joints have moved at a time under the law q̇ = clip(gain · (q_target - q), ±velocity_limit).

    A joint moves at the limit as long as the law asks for more, then approaches its target exponentially: it does not
    overshoot.

    Args:
        q: current positions (..., J), rad.
        q_target: target positions (..., J), rad.
        gain: 1/s, (..., J).
        velocity_limit: rad/s, (..., J).
        time: from now, s; broadcasts against the others.

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


def late_servo_motion(
    q: Floats,
    q_target: tuple[Floats, Floats],
    gain: Floats,
    velocity_limit: Floats,
    time: Floats,
    change: Floats,
) -> Floats:
    """How far joints have moved under the law of `servo_motion`, with a target that changes on the way.

    Args:
        q, gain, velocity_limit, time: as in `servo_motion`.
        q_target: the old and the new target positions, each (..., J), rad.
        change: when the new target takes effect, s; broadcasts against the others.

    Returns:
        The displacements at each time (K, ..., J), rad; the last time is not before the change.
    """
    old, new = q_target
    before = servo_motion(q, old, gain, velocity_limit, np.minimum(time, change))
    after = np.maximum(time - change, 0.0)
    return before + servo_motion(q + before[-1], new, gain, velocity_limit, after)
