"""The record of a moving arm: what its joints were told, and what they did."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.types import Floats

SHORTEST = 2.0
"""The shortest log, s."""
LEAST_MOTION = 0.01
"""A joint whose targets and positions stay within this range, rad (m), does not move."""
_UNEVEN = 0.01
"""How much a period may differ from the others, as a part of it."""


@dataclass(frozen=True, eq=False)
class Log:
    """Joint targets and measured joint states at the ticks of a control period, in the robot's order of joints.

    The target of a tick is the last one that was sent until then. It is in force until the next tick.

    Raises:
        GymMaraError: an array has another shape or is not finite, the times are not evenly spaced, or the log is too short.
    """

    times: Floats
    """When (T,), s."""
    targets: Floats
    """Joint targets (T, J), rad (m)."""
    q: Floats
    """Measured joint positions (T, J), rad (m)."""
    qd: Floats
    """Measured joint velocities (T, J), rad/s (m/s)."""
    joint_names: tuple[str, ...] | None = None
    """The joints (J,), where they are known."""

    def __post_init__(self) -> None:
        count = len(self.times)
        if self.times.shape != (count,) or self.q.ndim != 2:
            raise GymMaraError(
                f"a log needs times (T,) and joint values (T, J), not {self.times.shape} and {self.q.shape}"
            )
        for name in ("targets", "q", "qd"):
            values = getattr(self, name)
            if values.shape != (count, self.q.shape[1]):
                raise GymMaraError(
                    f"{name} of a log must have a row for each of its {count} times and a column for each of "
                    f"{self.q.shape[1]} joints, not the shape {values.shape}"
                )
        for name in ("times", "targets", "q", "qd"):
            finite = np.isfinite(getattr(self, name))
            if not finite.all():
                row = int(np.argwhere(~finite)[0, 0])
                raise GymMaraError(f"{name} of the log is not finite at tick {row}: leave it out")
        self._check_times(count)

    def _check_times(self, count: int) -> None:
        if count < 2 or self.times[-1] - self.times[0] < SHORTEST:
            duration = self.times[-1] - self.times[0] if count else 0.0
            raise GymMaraError(
                f"the log is too short: it has {duration:.3g} s, and at least {SHORTEST:g} s are needed"
            )
        steps = np.diff(self.times)
        if np.abs(steps - self.control_period).max() > _UNEVEN * self.control_period:
            raise GymMaraError(
                f"the times of a log must be evenly spaced; its periods are {steps.min():.4g} s to {steps.max():.4g} s: "
                "resample it"
            )

    @property
    def control_period(self) -> float:
        """The time between two ticks, s, to the microsecond."""
        return round(float(self.times[-1] - self.times[0]) / (len(self.times) - 1), 6)

    @property
    def duration(self) -> float:
        """From the first tick to the last one, s."""
        return float(self.times[-1] - self.times[0])

    @property
    def moving(self) -> tuple[int, ...]:
        """The joints that were told to move or did, by number: one that is too weak may be moved by the others.

        Raises:
            GymMaraError: there is none.
        """
        told = np.ptp(self.targets, axis=0) >= LEAST_MOTION
        did = np.ptp(self.q, axis=0) >= LEAST_MOTION
        if not (told & did).any():
            raise GymMaraError(
                f"the arm of the log does not move: no joint was told to move by {LEAST_MOTION:g} rad (m), and did"
            )
        return tuple(np.flatnonzero(told | did).tolist())

    def require(self, joint_names: Sequence[str], robot: str) -> None:
        """Check that the log is of an arm with these joints.

        Raises:
            GymMaraError: it is not.
        """
        own = self.joint_names
        if own is not None and own != tuple(joint_names):
            raise GymMaraError(
                f"the log has the joints {', '.join(own)}, and {robot} has {', '.join(joint_names)}: name the robot of the log"
            )
        if self.q.shape[1] != len(joint_names):
            raise GymMaraError(
                f"the log has {self.q.shape[1]} joints, and {robot} has {len(joint_names)}: name the robot of the log"
            )
