"""What was identified from a log, and how sure it is."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Estimate:
    """A parameter of a joint, or of the whole arm."""

    name: str
    """As in `randomisation`."""
    joint: str | None
    """The joint; None for the whole arm."""
    value: float
    """s, Nm (N) or a scale, as in `randomisation`."""
    standard_error: float | None
    """Of the value; None where the log does not determine it."""
    low: float
    """The lower end of the range: two standard errors below the value, but not out of the prior range."""
    high: float
    """The upper end."""
    undetermined: str | None = None
    """Why the log does not determine the value, if so; the range is then the prior one."""


@dataclass(frozen=True)
class Identified:
    """The parameters with which a backend follows a log best."""

    robot: str
    backend: str
    settings: dict[str, Any]
    """Keyword arguments of the backend; the parameters are for these."""
    duration: float
    """Of the log, s."""
    error: dict[str, float]
    """The root mean square error of each joint with these parameters, rad (m)."""
    error_before: dict[str, float]
    """The same with the robot's own parameters."""
    estimates: tuple[Estimate, ...]

    @property
    def randomisation(self) -> dict[str, tuple[float, float]]:
        """Ranges for the keyword `randomisation`: for each name, of all joints for which the log determines it."""
        ranges: dict[str, tuple[float, float]] = {}
        for each in self.estimates:
            if each.undetermined is None:
                low, high = ranges.get(each.name, (each.low, each.high))
                ranges[each.name] = min(low, each.low), max(high, each.high)
        return ranges

    def to_json(self) -> dict[str, Any]:
        """Plain values for a JSON file; `randomisation` can be given to an environment as it is."""
        ranges = {name: list(ends) for name, ends in self.randomisation.items()}
        return asdict(self) | {
            "estimates": [asdict(e) for e in self.estimates],
            "randomisation": ranges,
        }
