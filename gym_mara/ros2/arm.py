"""What an arm behind topics reports, what it is told, and the connection to it. Nothing here needs ROS."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import NamedTuple, Protocol

from gym_mara.types import Floats


class ArmState(NamedTuple):
    """A state that an arm has reported: complete, finite, and in the robot's order of joints."""

    q: Floats
    """Joint positions (J,), rad (m for a prismatic joint)."""
    qd: Floats
    """Joint velocities (J,), rad/s (m/s)."""
    effort: Floats | None
    """Joint efforts (J,), Nm (N); None where the arm reports none."""
    received: float
    """When it arrived, s, on the clock of this process."""
    stamp: float
    """The time in its header, s, on the clock of the sender; 0 where it has none."""


class Setpoint(NamedTuple):
    """Where the joints shall be at an instant, and how they shall move."""

    q: Floats
    """Joint positions (J,), rad (m)."""
    qd: Floats
    """Joint velocities (J,), rad/s (m/s)."""
    qdd: Floats
    """Joint accelerations (J,), rad/s² (m/s²)."""


class Clock(Protocol):
    """The clock that sets the pace: monotonic, s."""

    def now(self) -> float:
        """The time, s."""

    def sleep_until(self, instant: float) -> None:
        """Return at this time, s, or at once if it has passed."""


class WallClock:
    """The monotonic clock of this machine."""

    def now(self) -> float:
        """As in `Clock`."""
        return time.monotonic()

    def sleep_until(self, instant: float) -> None:
        """As in `Clock`."""
        rest = instant - time.monotonic()
        if rest > 0.0:
            time.sleep(rest)


class Link(Protocol):
    """The connection to one arm. Its methods may be called from any thread."""

    @property
    def state(self) -> ArmState | None:
        """The last state that was accepted; None before the first."""

    @property
    def refused(self) -> Mapping[str, int]:
        """How many messages were refused, by reason."""

    def send(self, setpoint: Setpoint, period: float) -> None:
        """Command a set-point, which is to be reached a period, s, from now."""

    def close(self) -> None:
        """End the connection. A second call has no effect."""
