"""Joint targets that show an arm's parameters: steps and sums of sines, in a box of free configurations."""

from __future__ import annotations

import numpy as np

from gym_mara.collision.coal import CoalChecker
from gym_mara.errors import GymMaraError, positive_number
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.types import Floats

_CENTRES, _SAMPLES = 64, 256
_WIDEST, _NARROWEST = 1.0, 0.1
"""Half the width of the box, rad (m)."""
_ROOM = 0.1
"""How far beyond the box a joint is still free, rad (m): where its motor is weak it overshoots."""
_BLOCK = 4.0
"""How long steps and sines take turns, s."""
_HOLD = (0.1, 0.7)
"""How long the target of a step stays, s: often shorter than the joint takes, so that it turns back at full speed."""
_FREQUENCIES = (0.2, 1.5)
"""Of the sines, Hz."""


def excitation(
    robot: RobotModel, duration: float, control_period: float = 0.02, *, seed: int = 0
) -> Floats:
    """Joint targets (T, J), rad (m), for the ticks of a control period; the arm is to begin at rest at the first one.

    Every joint moves on its own: three quarters of the time by steps at random times, which ask for the highest velocity and
    effort, and else by three sines. All targets are in a box around a configuration, in which random configurations are free
    of collisions, also a little beyond it. The box is the largest that is found.

    Args:
        robot: the arm.
        duration: s.
        control_period: s.
        seed: of the random motion.

    Raises:
        GymMaraError: a time is not positive, or no box is free.
    """
    duration = positive_number("duration", duration, "s", at_most=3600.0, reason="it is enough")
    control_period = positive_number("control_period", control_period, "s", at_most=1.0)
    ticks = round(duration / control_period) + 1
    centre, half = free_box(robot)
    generator = np.random.default_rng(seed)
    columns = [_motion(ticks, control_period, generator) for _ in range(robot.num_joints)]
    return np.clip(centre + half * np.stack(columns, axis=1), robot.lower, robot.upper)


def free_box(robot: RobotModel) -> tuple[Floats, Floats]:
    """The centre and half the width (J,), rad (m), of a box of configurations without collisions.

    Raises:
        GymMaraError: none is found.
    """
    low, high = reachable_range(robot)
    checker, generator = CoalChecker(robot), np.random.default_rng(0)
    inner = 0.75 * low + 0.25 * high, 0.25 * low + 0.75 * high
    centres = np.vstack([robot.home, generator.uniform(*inner, (_CENTRES, robot.num_joints))])
    unit = generator.uniform(-1.0, 1.0, (_SAMPLES, robot.num_joints))
    unit[: _SAMPLES // 2] = np.sign(unit[: _SAMPLES // 2])  # corners
    for half in np.geomspace(_WIDEST, _NARROWEST, 8):
        for centre in centres:
            around = np.clip(centre + (half + _ROOM) * unit, low, high)
            # Most boxes are ruled out by a few configurations.
            if not checker.check(around[::16]).any() and not checker.check(around).any():
                lowest, highest = np.maximum(centre - half, low), np.minimum(centre + half, high)
                return 0.5 * (lowest + highest), 0.5 * (highest - lowest)
    raise GymMaraError(
        f"{robot.name} has no configuration around which every joint can move by {_NARROWEST:g} rad (m) without a collision"
    )


def _motion(ticks: int, period: float, generator: np.random.Generator) -> Floats:
    """The motion of one joint (T,), from -1 to 1, which begins at 0."""
    path, tick = np.zeros(ticks), 1
    stepping = True
    while tick < ticks:
        end = min(ticks, tick + round(_BLOCK * (0.75 if not stepping else 1.0) / period))
        time = np.arange(0.0, end - tick) * np.float64(period)
        if stepping:
            path[tick:end] = _steps(time, generator)
        else:
            path[tick:end] = _sines(time, path[tick - 1], generator)
        tick, stepping = end, not stepping
    return path


def _steps(time: Floats, generator: np.random.Generator) -> Floats:
    changes = np.cumsum(generator.uniform(*_HOLD, len(time) + 1))
    values = generator.uniform(0.2, 1.0, len(changes) + 1) * generator.choice(
        (-1.0, 1.0), len(changes) + 1
    )
    return values[np.searchsorted(changes, time)]


def _sines(time: Floats, start: float, generator: np.random.Generator) -> Floats:
    frequency = generator.uniform(*_FREQUENCIES, 3)
    phase = generator.uniform(0.0, 2.0 * np.pi, 3)
    waves = np.sin(2.0 * np.pi * np.outer(time, frequency) + phase).mean(axis=1)
    blend = np.exp(-time / 0.2)  # from where the joint is
    return blend * start + (1.0 - blend) * waves
