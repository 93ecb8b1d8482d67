"""The errors a user can mend: each says what was wrong, what is allowed and what to do."""

from __future__ import annotations

import difflib
import math
import numbers
from collections.abc import Iterable
from typing import Any


class GymMaraError(ValueError):
    """Wrong input to gym_mara."""


class MissingExtraError(GymMaraError, ImportError):
    """A library that an optional part needs is not installed, or too old."""

    def __init__(
        self, part: str, library: str, extra: str, why: str = "which is not installed"
    ) -> None:
        super().__init__(f"{part} needs {library}, {why}: pip install 'gym_mara[{extra}]'")
        self._arguments = part, library, extra, why

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str, str, str]]:
        return type(self), self._arguments


class TrainingDivergedError(GymMaraError):
    """A training cannot go on: its numbers are no longer finite."""


def positive_number(name: str, value: Any, unit: str = "", *, or_zero: bool = False) -> float:
    """A value that must be a finite, positive number, or zero where that is allowed.

    Raises:
        GymMaraError: it is not.
    """
    if not isinstance(value, bool) and isinstance(value, numbers.Real):
        number = float(value)
        if 0.0 < number < math.inf or (or_zero and number == 0.0):
            return number
    wanted = "not negative" if or_zero else "positive"
    raise GymMaraError(
        f"{name} must be finite and {wanted}{f' ({unit})' if unit else ''}, not {value!r}"
    )


def whole_number(name: str, value: Any) -> int:
    """A value that must be a whole number of at least 1.

    Raises:
        GymMaraError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < 1:
        raise GymMaraError(f"{name} must be a whole number of at least 1, not {value!r}")
    return int(value)


def unknown(kind: str, name: object, valid: Iterable[str], where: str = "") -> GymMaraError:
    """An error for a name that is not among the valid ones, with the nearest of them."""
    names = sorted(valid)
    near = difflib.get_close_matches(str(name), names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return GymMaraError(f"unknown {kind} {name!r}{where}.{hint} Valid: {', '.join(names)}.")
