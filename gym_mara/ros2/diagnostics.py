"""What a deployment reports about itself."""

from __future__ import annotations

from typing import NamedTuple

from gym_mara.ros2.driver import Timing


class Diagnostics(NamedTuple):
    """What a deployment reports about itself."""

    status: str
    """What the arm does, in words, such as "waits for a target", or "stopped: " and why."""
    in_trouble: bool
    """Whether it is stopped or has failed, or reports no state."""
    steps: int
    missed_ticks: int
    """Of the policy, control periods."""
    lateness: tuple[float, float]
    """How long after its tick an action came, s: the median and the 99th percentile of the last actions."""
    state_age: float
    """Of the last state, s."""
    refused: dict[str, int]
    """How many messages of the arm were refused, by reason."""
    setpoints: Timing
    """Of the thread that sends set-points."""
    error: float | None
    """The distance to the target, m; None where there is none yet."""
    setpoint: tuple[float, ...]
    """The last set-point (J,), rad (m), which is sent only if the deployment is live; empty before the first."""

    def rows(self) -> list[tuple[str, str]]:
        """The figures with their names, as text."""
        late, ticks = self.lateness, self.setpoints
        refused = ", ".join(f"{reason} {count}" for reason, count in self.refused.items())
        return [
            (
                "distance to the target, mm",
                "-" if self.error is None else f"{1e3 * self.error:.3f}",
            ),
            ("actions", f"{self.steps:,}"),
            ("missed control periods", f"{self.missed_ticks:,}"),
            ("lateness of actions, p50 and p99, ms", f"{1e3 * late[0]:.2f}, {1e3 * late[1]:.2f}"),
            ("set-points", f"{ticks.ticks:,}"),
            ("missed set-points", f"{ticks.missed:,}"),
            (
                "jitter of set-points, p50, p99 and largest, ms",
                ", ".join(f"{1e3 * value:.2f}" for value in ticks.lateness),
            ),
            ("age of the arm's state, ms", f"{1e3 * self.state_age:.1f}"),
            ("refused messages", refused or "none"),
            ("set-point", ", ".join(f"{value:.3f}" for value in self.setpoint)),
        ]
