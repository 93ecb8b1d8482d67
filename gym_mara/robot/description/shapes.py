"""The shapes that a robot's links are made of, the same for every engine and for pictures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gym_mara.types import Floats

if TYPE_CHECKING:
    import trimesh


@dataclass(frozen=True, eq=False)
class Box:
    """A box, centred at the origin."""

    size: Floats
    """Lengths along x, y and z (3,), m."""


@dataclass(frozen=True)
class Sphere:
    """A sphere, centred at the origin."""

    radius: float
    """m."""


@dataclass(frozen=True)
class Cylinder:
    """A cylinder along z, centred at the origin."""

    radius: float
    """m."""
    length: float
    """m."""


@dataclass(frozen=True)
class Capsule:
    """A cylinder along z with a half sphere at each end, centred at the origin."""

    radius: float
    """m."""
    length: float
    """Of the cylinder, m."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """The triangles of a mesh file, or their convex hull."""

    path: str
    parts: tuple[trimesh.Trimesh, ...]
    """Placed and scaled, m, with their colours. Robots share them: they must not be changed."""
    convex: bool = False
    """Whether the shape is the convex hull, which is then the only part."""

    @cached_property
    def vertices(self) -> Floats:
        """Of all parts (V, 3), m."""
        return np.concatenate([np.asarray(part.vertices, np.float64) for part in self.parts])

    @cached_property
    def faces(self) -> NDArray[np.int64]:
        """Triangles (F, 3), as indices of vertices; their corners are anticlockwise seen from outside."""
        starts = np.cumsum([0, *(len(part.vertices) for part in self.parts[:-1])])
        faces = [part.faces + start for part, start in zip(self.parts, starts, strict=True)]
        return np.concatenate(faces).astype(np.int64)

    @cached_property
    def hull(self) -> Mesh:
        """The convex hull of all parts; the mesh itself where it is one, or is flat and encloses no volume."""
        if self.convex or self._is_flat():
            return self
        import trimesh  # few robots here have meshes

        return Mesh(self.path, (trimesh.convex.convex_hull(self.vertices),), convex=True)

    def _is_flat(self) -> bool:
        lengths = np.linalg.svd(self.vertices - self.vertices.mean(axis=0), compute_uv=False)
        return bool(lengths[-1] <= 1e-9 * lengths[0])


Shape = Box | Sphere | Cylinder | Capsule | Mesh
