"""Checks a snapshot before anything is restored from it, so that one of another environment changes nothing."""

from __future__ import annotations

import math
from collections import deque
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
