"""Errors that a user can correct. Each message states what was wrong, what is allowed and what to do."""

from __future__ import annotations

import difflib
import math
import numbers
from collections.abc import Iterable
from typing import Any

import numpy as np


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


SMALLEST, LARGEST = 1e-9, 1e9
"""The range of positive numbers without a range of their own: arithmetic with others keeps enough digits."""
MOST_COUNTED = 2**53
"""The largest whole number that float64, in which steps are counted, can represent together with all smaller ones."""


def positive_number(
    name: str,
    value: Any,
    unit: str = "",
    *,
    or_zero: bool = False,
    at_least: float = SMALLEST,
    at_most: float = LARGEST,
    reason: str = "others lose the precision of the arithmetic",
) -> float:
    """Check that a value is a positive number within a range, or zero if `or_zero` is true, and return it as a float.

    Args:
        name: the name of the value, for the message.
        value: the value: a number of Python or NumPy.
        unit: its unit, for the message.
        or_zero: whether zero is allowed.
        at_least, at_most: the range of positive numbers.
        reason: why others are not allowed, for the message.

    Raises:
        GymMaraError: it is not.
    """
    plain, number = _plain(value), math.nan
    if isinstance(plain, numbers.Real) and not isinstance(plain, bool):
        try:
            number = float(plain)
        except OverflowError:
            number = math.inf
    if not (0.0 < number < math.inf or (or_zero and number == 0.0)):
        allowed = f"finite and {'not negative' if or_zero else 'positive'}"
    elif number > at_most:
        allowed = f"at most {at_most:g}"
    elif 0.0 < number < at_least:
        allowed = f"at least {at_least:g}"
    else:
        return number
    because = "" if "finite" in allowed else f", because {reason}"
    in_units = f" ({unit})" if unit else ""
    raise GymMaraError(f"{name} must be {allowed}{in_units}{because}, not {short(value, 200)}")


def whole_number(
    name: str,
    value: Any,
    *,
    or_else: str = "",
    at_most: int = MOST_COUNTED,
    reason: str = "larger ones cannot be counted exactly",
) -> int:
    """Check that a value is a whole number from 1 to `at_most`, and return it as an int.

    Args:
        name: the name of the value, for the message.
        value: the value: a whole number of Python or NumPy.
        or_else: another allowed value, for the message, such as "None for no limit".
        at_most: the largest number.
        reason: why larger ones are not allowed, for the message.

    Raises:
        GymMaraError: it is not.
    """
    plain = _plain(value)
    whole = isinstance(plain, numbers.Integral) and not isinstance(plain, bool)
    number = int(plain) if whole else 0
    if number < 1:
        other = f", or {or_else}" if or_else else ""
        raise GymMaraError(
            f"{name} must be a whole number of at least 1{other}, not {short(value, 200)}"
        )
    if number > at_most:
        raise GymMaraError(
            f"{name} must be at most {at_most}, because {reason}; not {short(value, 200)}"
        )
    return number


def flag(name: str, value: Any) -> bool:
    """Check that a value is True or False, of Python or NumPy, and return it as a bool.

    Raises:
        GymMaraError: it is not.
    """
    plain = _plain(value)
    if not isinstance(plain, (bool, np.bool_)):
        raise GymMaraError(f"{name} must be True or False, not {short(value, 200)}")
    return bool(plain)


def finite_numbers(name: str, values: Any, count: int | None = None) -> list[float]:
    """Check that values are a list or array of finite numbers, and return them as floats.

    Args:
        name: the name of the values, for the message.
        values: the values.
        count: how many there must be; None for any number.

    Raises:
        GymMaraError: they are not.
    """
    try:
        array = np.asarray(values)
    except ValueError:  # lists of different lengths
        array = np.array(None)
    good = array.ndim == 1 and array.dtype.kind in "fiu" and count in (None, len(array))
    if not (good and bool((np.abs(array.astype(np.float64)) <= LARGEST).all())):
        many = f"{count} " if count else ""
        raise GymMaraError(
            f"{name} must be a list of {many}finite numbers, each within ±{LARGEST:g}, not {short(values, 200)}"
        )
    return [float(value) for value in array]


def one_of(kind: str, name: object, valid: Iterable[str]) -> str:
    """Check that a name is one of the valid names, and return it.

    Raises:
        GymMaraError: it is not.
    """
    names = list(valid)
    if not isinstance(name, str) or name not in names:
        raise unknown(kind, name, names)
    return str(name)


def short(value: Any, longest: int = 60) -> str:
    """The value for an error message, in at most this many characters."""
    try:
        text = repr(value)
    except ValueError:  # an integer with more digits than Python prints
        return "a huge number"
    return text if len(text) <= longest else f"{text[: longest - 3]}..."


def _plain(value: Any) -> Any:
    """The number in an array without dimensions; any other value unchanged."""
    return value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value


def unknown(kind: str, name: object, valid: Iterable[str], where: str = "") -> GymMaraError:
    """Make the error for an unknown name. It suggests the most similar valid name and lists all of them."""
    names = sorted(valid)
    similar = difflib.get_close_matches(str(name), names, n=1)
    hint = f" Did you mean {similar[0]!r}?" if similar else ""
    return GymMaraError(f"unknown {kind} {name!r}{where}.{hint} Valid: {', '.join(names)}.")
