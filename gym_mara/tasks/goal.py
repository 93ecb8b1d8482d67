"""Goal: the poses to reach."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from gym_mara import rotations
from gym_mara.arrays import contiguous, namespace
from gym_mara.types import Floats


@dataclass(frozen=True, eq=False)
class Goal:
    """The target pose of each of N arms, in the world frame."""

    position: Floats
    """Positions (N, 3), m."""
    quaternion: Floats
    """Quaternions (N, 4), [w, x, y, z]."""

    @cached_property
    def _inverse(self) -> Floats:
        # Contiguous: the last bits of a dot product depend on the memory layout, which a copy of it could change.
        return contiguous(rotations.right_matrix(rotations.conjugate(self.quaternion)))

    def orientation_error(self, quaternion: Floats) -> Floats:
        """The rotation from the goal to the end effector: q ⊗ conj(goal) (N, 4), w >= 0, for orientations q (N, 4)."""
        xp = namespace(quaternion)
        return rotations.canonical(xp.vecdot(self._inverse, quaternion[..., None, :]))
