"""Checks a snapshot before anything is restored from it, so that one of another environment changes nothing."""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from collections.abc import Mapping, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np

from gym_mara.errors import GymMaraError, short


def check_fits(name: str, value: Any, like: Any) -> None:
    """Check that a value of a snapshot has the form of an example.

    A dictionary must have the same keys, a sequence the same length, and an array the same shape and kind of numbers. Numbers
    must be finite. Any other value must have the same type. An example that is a type stands for any value of it.

    Args:
        name: the name of the value, for the message.
        value: the value.
        like: the example.

    Raises:
        GymMaraError: it has another form.
    """
    if isinstance(like, (np.ndarray, np.generic)):
        fits = (
            isinstance(value, (np.ndarray, np.generic))
            and value.shape == like.shape
            and value.dtype.kind == like.dtype.kind
            and (like.dtype.kind != "f" or bool(np.isfinite(value).all()))
        )
    else:
        fits = type(value) is (like if isinstance(like, type) else type(like))
        if fits and isinstance(like, float):
            fits = math.isfinite(value)
        elif fits and isinstance(like, dict):
            fits = value.keys() == like.keys()
        elif fits and isinstance(like, (tuple, list, deque)):
            fits = len(value) == len(like)
    if not fits:
        raise GymMaraError(
            f"{name} of the snapshot does not fit here: {short(value)}; "
            "restore only what an environment with the same arguments has saved"
        )
    if isinstance(like, dict):
        for key, example in like.items():
            check_fits(f"{name}[{key!r}]", value[key], example)
    elif isinstance(like, (tuple, list, deque)):
        for index, example in enumerate(like):
            check_fits(f"{name}[{index}]", value[index], example)


_OLD_ARGUMENTS = ("robot", "backend", "num_envs", "action")
"""What snapshots of 0.2.0 say of the arguments of their environment, in a tuple."""


def check_same_arguments(saved: Any, here: Mapping[str, Any]) -> None:
    """Check that a snapshot is of an environment with the arguments of this one.

    Arguments that the snapshot does not have, because its version did not, are not compared.

    Args:
        saved: the arguments in the snapshot, of the form of `plain`.
        here: those of the environment.

    Raises:
        GymMaraError: an argument has another value, or these are no arguments.
    """
    if isinstance(saved, tuple) and len(saved) == len(_OLD_ARGUMENTS):
        saved = dict(zip(_OLD_ARGUMENTS, saved, strict=True))
    if not (isinstance(saved, dict) and saved.keys() >= set(_OLD_ARGUMENTS)):
        raise GymMaraError(
            f"{short(saved)} are not the arguments of an environment: restore only a snapshot of save_state"
        )
    others = [name for name in saved.keys() & here.keys() if saved[name] != here[name]]
    if others:
        found = ", ".join(
            f"{name} {short(saved[name])} (here {short(here[name])})" for name in sorted(others)
        )
        raise GymMaraError(
            f"the snapshot is of an environment with {found}: "
            "restore only what an environment with the same arguments has saved"
        )


def plain(value: Any) -> Any:
    """A value of a keyword argument in a form that is equal for equal values, of types that a checkpoint can hold."""
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, np.bool_):
        return bool(value)
    if isinstance(value, Real):
        return int(value) if isinstance(value, Integral) else float(value)
    if isinstance(value, Mapping):
        return {str(key): plain(each) for key, each in value.items()}
    if isinstance(value, (Sequence, np.ndarray)):
        return tuple(plain(each) for each in value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        values = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
        return plain({**values, "class": type(value).__qualname__})
    return type(value).__qualname__  # of no plain type; its repr may have an address
