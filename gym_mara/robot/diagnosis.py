"""What is wrong with a robot's description, found when it is loaded: each finding says what follows and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from gym_mara.errors import GymMaraError

Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """Something in a robot's description that a user should know."""

    severity: Severity
    """An error cannot be simulated faithfully; a warning can, but is probably not meant; a note is for the table alone."""
    part: str
    """What it is about: "joint j1", "link l2", "links l1 and l3", "robot"."""
    message: str
    """What is wrong."""
    effect: str
    """What follows."""
    remedy: str
    """What to do."""
    dynamics: bool = False
    """Whether only backends with dynamics are concerned."""

    def __str__(self) -> str:
        where = "on backends with dynamics, " if self.dynamics else ""
        return f"{self.part}: {self.message}; {where}{self.effect}. {self.remedy}"


def raise_errors(name: str, findings: Iterable[Finding], *, dynamics: bool) -> None:
    """Raise the errors among findings: those of backends with dynamics, or those of every backend.

    Raises:
        GymMaraError: there are any.
    """
    errors = [f for f in findings if f.severity == "error" and f.dynamics == dynamics]
    if errors:
        raise GymMaraError(
            f"the robot {name!r} cannot be simulated{' with dynamics' if dynamics else ''}:\n"
            + "\n".join(f"- {finding}" for finding in errors)
        )
