"""What a `<joint>` of a URDF says, for a URDF that `check_urdf` accepts."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.types import Floats

ROUNDED = 1e-3
"""A position this little beyond a limit is rounded, rad (m)."""
_TURN = 2.0 * math.pi


def limits_of(urdf: Path, joint: ElementTree.Element) -> tuple[float, float]:
    """The limits of a joint, rad (m); zero where it has none, as Pinocchio reads them.

    Raises:
        GymMaraError: they are in the wrong order.
    """
    limit = joint.find("limit")
    ends: Mapping[str, str] = {} if limit is None else limit.attrib
    lower, upper = (float(ends.get(end, "0")) for end in ("lower", "upper"))
    if lower > upper:
        raise GymMaraError(
            f"{str(urdf)!r}: joint {joint.get('name')!r} has the lower limit {lower:g}, above its upper limit {upper:g}"
        )
    return lower, upper


def within_limits(position: float, lower: float, upper: float, *, turns: bool) -> float:
    """A position within a joint's limits, rad (m).

    If a joint that `turns` is beyond them, the least number of whole turns that brings it within is added. Where none does, it is
    put at the nearer limit.
    """
    if turns and not lower - ROUNDED <= position <= upper + ROUNDED:
        fewest = math.ceil((lower - ROUNDED - position) / _TURN)
        most = math.floor((upper + ROUNDED - position) / _TURN)
        if fewest <= most:
            position += _TURN * (fewest if position < lower else most)
    return min(max(position, lower), upper)


def axis_of(urdf: Path, joint: ElementTree.Element) -> Floats:
    """The unit vector of a joint's axis (3,).

    Raises:
        GymMaraError: it has length zero.
    """
    element = joint.find("axis")
    axis = vector("1 0 0" if element is None else element.get("xyz", "1 0 0"))
    length = float(np.linalg.norm(axis))
    if length == 0.0:
        raise GymMaraError(
            f"{str(urdf)!r}: the axis of joint {joint.get('name')!r} has length zero"
        )
    return axis / length


def vector(text: str) -> Floats:
    """The numbers in the value of an attribute."""
    return np.array([float(part) for part in text.split()])


def link_at(joint: ElementTree.Element, end: str) -> str:
    """The name of a joint's parent or child link."""
    element = joint.find(end)
    return "" if element is None else element.get("link", "")
