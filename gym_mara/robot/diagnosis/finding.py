"""Finding: something in a robot's description that a user should know, and what to do."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from gym_mara.errors import GymMaraError

Severity = Literal["error", "warning", "note"]
_SHOWN = 10
"""The number of names that a finding lists, unless it says otherwise."""
_warned: set[tuple[str, Finding]] = set()
"""The findings of files of which was warned: a program loads the same files many times, a training three times."""


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


def raise_errors(name: str, findings: Iterable[Finding]) -> None:
    """Raise the errors among findings, which are about dynamics: what no backend can simulate is refused when it is read.

    Raises:
        GymMaraError: there are any.
    """
    errors = [f for f in findings if f.severity == "error"]
    if errors:
        raise GymMaraError(
            f"the robot {name!r} cannot be simulated with dynamics:\n"
            + "\n".join(f"- {finding}" for finding in errors)
        )


def warn(source: str, findings: Iterable[Finding], *, dynamics: bool, stacklevel: int) -> None:
    """Warn of each warning among findings, once in a process: those of backends with dynamics, or those of every backend.

    Args:
        source: the file that they are about.
        findings: the findings.
        dynamics: which of them.
        stacklevel: 1 for the caller of this function, 2 for its caller, and so on.
    """
    for finding in findings:
        if finding.severity != "warning" or finding.dynamics != dynamics:
            continue
        if (source, finding) not in _warned:
            _warned.add((source, finding))
            warnings.warn(f"{source}: {finding}", stacklevel=stacklevel + 1)


def listed(names: Sequence[str], most: int = _SHOWN) -> str:
    """The names for a message: some of them, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def parts(kind: str, names: Sequence[str]) -> str:
    """What a finding is about: "joint j1", "joints j1, j2"."""
    return f"{kind}{'s' if len(names) > 1 else ''} {listed(names)}"
