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
    configurations: Floats | None = None
    """Configurations of the arm at the goals (N, K, J), rad (m), infinite where there are fewer; None if the task needs none."""

    def ways(self, q: Floats) -> Floats:
        """The way (N, J), rad (m), from configurations q (N, J) to the nearest one at the goal; zero if none is known.

        The nearest one is that whose farthest joint has the shortest way. Collisions on the way are not considered.
        """
        xp = namespace(q)
        if self.configurations is None:
            return xp.zeros_like(q)
        ways = self.configurations - q[:, None]
        nearest = xp.argmin(xp.max(xp.abs(ways), axis=-1), axis=-1)
        way = ways[xp.arange(len(nearest), device=nearest.device), nearest]
        return xp.where(xp.isfinite(way), way, xp.zeros_like(way))

    @cached_property
    def _inverse(self) -> Floats:
        # Contiguous: the last bits of a dot product depend on the memory layout, which a copy of it could change.
        return contiguous(rotations.right_matrix(rotations.conjugate(self.quaternion)))

    def orientation_error(self, quaternion: Floats) -> Floats:
        """The rotation from the goal to the end effector: q ⊗ conj(goal) (N, 4), w >= 0, for orientations q (N, 4)."""
        xp = namespace(quaternion)
        return rotations.canonical(xp.vecdot(self._inverse, quaternion[..., None, :]))
