"""The watchdogs of the safety filter: what is wrong with a clock, a state, or the numbers of a message."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from gym_mara.errors import GymMaraError, positive_number
from gym_mara.ros2.arm import ArmState

_UNITS = {"state_age": "s", "command_age": "s", "tracking_error": "rad", "rest_velocity": "rad/s"}


@dataclass(frozen=True)
class Watchdogs:
    """What stops the arm, or keeps it from starting, if it is exceeded.

    Raises:
        GymMaraError: a limit is no positive number.
    """

    state_age: float = 0.1
    """The largest age of the measured state, and the longest time between two set-points of a moving arm, s."""
    command_age: float = 0.2
    """The largest age of the command, s."""
    tracking_error: float = 0.2
    """How far a joint may be from its set-point, rad (m)."""
    rest_velocity: float = 0.02
    """How fast a joint may be measured where the arm starts or resumes, rad/s (m/s): what is measured at rest is never exactly zero."""

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            unit = _UNITS[field.name]
            object.__setattr__(self, field.name, positive_number(field.name, value, unit))


class Guard:
    """Checks the messages of one arm.

    Args:
        joint_names: the names of the joints (J).
        watchdogs: the limits.
    """

    def __init__(self, joint_names: Sequence[str], watchdogs: Watchdogs) -> None:
        self._joints, self._watchdogs = tuple(joint_names), watchdogs

    def wrong_state(
        self, now: float, state: ArmState | None, setpoint: Sequence[float]
    ) -> str | None:
        """What is wrong with a state, or with how the arm follows its set-point (J,); None if nothing is."""
        if state is None:
            return "the arm reports no state"
        trouble = too_old("the arm's state", now, state.received, self._watchdogs.state_age)
        if trouble:
            return trouble
        q = self.numbers(state.q)
        if isinstance(q, str):
            return f"the arm's state {q}"
        largest = self._watchdogs.tracking_error
        for joint, measured, wanted in zip(self._joints, q, setpoint, strict=True):
            if not -largest <= measured - wanted <= largest:
                return (
                    f"the arm does not follow: {joint} is {abs(measured - wanted):.3g} rad (m) from its set-point, and "
                    f"{largest:g} are allowed"
                )
        return None

    def check_rest(self, now: float, state: ArmState) -> None:
        """Check that a state is fresh, and the arm at rest.

        Raises:
            GymMaraError: it is not.
        """
        trouble = too_old("the arm's state", now, state.received, self._watchdogs.state_age)
        if trouble:
            raise GymMaraError(f"{trouble}: check that it is published")
        velocity = self.numbers(state.qd)
        if isinstance(velocity, str):
            raise GymMaraError(f"the arm's velocity {velocity}")
        fastest = int(np.abs(velocity).argmax())
        if abs(velocity[fastest]) > (allowed := self._watchdogs.rest_velocity):
            raise GymMaraError(
                f"the arm moves: {self._joints[fastest]} at {velocity[fastest]:.3g} rad/s (m/s); it can start only at rest, "
                f"below {allowed:g}; if it rests and its encoders are noisy, give a larger rest_velocity"
            )

    def numbers(self, values: Any) -> list[float] | str:
        """J finite numbers, or what is wrong with the values."""
        try:
            array = np.asarray(values)
        except ValueError:  # lists of different lengths
            array = np.array(None)
        if array.dtype.kind not in "fiu":
            return "is not made of real numbers"
        if array.shape != (len(self._joints),):
            return f"has shape {array.shape}, not {(len(self._joints),)}"
        numbers: list[float] = array.astype(np.float64).tolist()
        for joint, number in zip(self._joints, numbers, strict=True):
            if not math.isfinite(number):
                return f"is not finite: {number} for {joint}"
        return numbers


def wrong_clock(before: float, now: float) -> str | None:
    """What is wrong with the time of a tick, s, after that of the tick before; None if nothing is."""
    if before < now < math.inf:
        return None
    if now == before:
        return "the clock stands still"
    return f"the clock jumps from {before:.6g} to {now:.6g} s"


def too_old(what: str, now: float, time: float, largest: float) -> str | None:
    """What is wrong with the time of a message, s: it is old, of the future, or no time; None if nothing is."""
    age = now - time
    if -largest <= age <= largest:
        return None
    if age > largest:
        return f"{what} is {age:.3g} s old, and {largest:g} s are allowed"
    return f"{what} has the time {time:.6g} s, and the clock shows {now:.6g} s"
