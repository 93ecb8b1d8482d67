"""View: what a renderer sees of an arm."""

from __future__ import annotations

from dataclasses import dataclass

from gym_mara.types import Floats


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """One arm at one instant, as it is to be shown."""

    q: Floats
    """(J,), rad."""
    target_position: Floats
    """(3,), m, in the world frame."""
    target_quaternion: Floats
    """(4,), [w, x, y, z]."""
    touching: frozenset[str] = frozenset()
    """The links that collide."""
