"""View: what a renderer needs to draw an arm."""

from __future__ import annotations

from dataclasses import dataclass

from gym_mara.types import Floats


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """One arm and its target at one instant."""

    q: Floats
    """Joint positions (J,), rad (m for a prismatic joint)."""
    target_position: Floats
    """The target's position in the world frame (3,), m."""
    target_quaternion: Floats
    """The target's orientation in the world frame (4,), [w, x, y, z]."""
    touching: frozenset[str] = frozenset()
    """The names of the links that collide."""
