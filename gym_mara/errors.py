"""Errors that a user can correct. Each message states what was wrong, what is allowed and what to do."""

from __future__ import annotations

import difflib
import math
import numbers
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray


class GymMaraError(ValueError):
    """The base class of gym_mara's errors; most of them report invalid input."""


class MissingExtraError(GymMaraError, ImportError):
    """An optional library is not installed, is too old, or cannot be imported.

    Args:
        part: the part of gym_mara that needs the library.
        library: the library.
        extra: the extra of gym_mara that installs the library.
        why: the reason, which follows the library in the message.
    """

    def __init__(
        self, part: str, library: str, extra: str, why: str = "which is not installed"
    ) -> None:
        super().__init__(f"{part} needs {library}, {why}: pip install 'gym_mara[{extra}]'")
        self._arguments = part, library, extra, why

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str, str, str]]:
        return type(self), self._arguments


class TrainingDivergedError(GymMaraError):
    """A training stopped because its values are no longer finite."""


def positive_number(name: str, value: Any, unit: str = "", *, or_zero: bool = False) -> float:
    """Check that a value is a finite, positive number, or zero if `or_zero` is true, and return it as a float.

    Raises:
        GymMaraError: it is not.
    """
    if not isinstance(value, bool) and isinstance(value, numbers.Real):
        number = float(value)
        if 0.0 < number < math.inf or (or_zero and number == 0.0):
            return number
    allowed = "not negative" if or_zero else "positive"
    raise GymMaraError(
        f"{name} must be finite and {allowed}{f' ({unit})' if unit else ''}, not {value!r}"
    )


def whole_number(name: str, value: Any, or_else: str = "") -> int:
    """Check that a value is a whole number of at least 1, and return it as an int.

    Args:
        name: the name of the value, for the message.
        value: the value.
        or_else: another allowed value, for the message, such as ", or None for no limit".

    Raises:
        GymMaraError: it is not.
    """
    if isinstance(value, bool) or not isinstance(value, numbers.Integral) or value < 1:
        raise GymMaraError(f"{name} must be a whole number of at least 1{or_else}, not {value!r}")
    return int(value)


def finite_vector(name: str, values: Any, length: int | None = None) -> NDArray[np.float64]:
    """Check that values are a list of finite numbers, of this length if one is given, and return them as a new array.

    Raises:
        GymMaraError: they are not.
    """
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise GymMaraError(f"{name} must be a list of numbers, not {values!r}") from error
    if array.ndim != 1 or length not in (None, len(array)) or not np.isfinite(array).all():
        count = f"{length} " if length else ""
        raise GymMaraError(f"{name} must be a list of {count}finite numbers, not {values!r}")
    return array


def unknown(kind: str, name: object, valid: Iterable[str], where: str = "") -> GymMaraError:
    """Make the error for an unknown name. It suggests the most similar valid name and lists all of them."""
    names = sorted(valid)
    similar = difflib.get_close_matches(str(name), names, n=1)
    hint = f" Did you mean {similar[0]!r}?" if similar else ""
    return GymMaraError(f"unknown {kind} {name!r}{where}.{hint} Valid: {', '.join(names)}.")
