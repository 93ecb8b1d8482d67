"""Reads mesh files, each once in a process: units, axes, node transforms and parts are those that the file describes."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

from gym_mara.errors import GymMaraError
from gym_mara.files import plain_size
from gym_mara.robot.description.shapes import Mesh

_KEPT = 256
"""The number of meshes that are kept for the next robot."""


def read_mesh(path: Path, scale: tuple[float, float, float], *, convex: bool) -> Mesh:
    """The mesh of a file, or its convex hull.

    Args:
        path: the file.
        scale: along x, y and z.
        convex: whether to take the hull.

    Raises:
        GymMaraError: the file is not a mesh, or holds no triangles or a vertex that is not finite.
    """
    return _scaled(path, (plain_size(path), path.stat().st_mtime_ns), scale, convex)


@lru_cache(maxsize=_KEPT)
def _scaled(
    path: Path, version: tuple[int, int], scale: tuple[float, float, float], convex: bool
) -> Mesh:
    if convex:
        return _scaled(path, version, scale, convex=False).hull
    parts = [part.copy().apply_scale(scale) for part in _parts(path, version)]
    return Mesh(str(path), tuple(parts))


@lru_cache(maxsize=_KEPT)
def _parts(path: Path, version: tuple[int, int]) -> tuple[trimesh.Trimesh, ...]:
    """The parts of a mesh file in the file's frame, m."""
    try:
        found = trimesh.load_scene(path).dump()
    except Exception as error:  # the readers of the formats raise whatever their parsers do
        raise GymMaraError(f"the mesh {str(path)!r} cannot be read: {error}") from error
    parts = tuple(p for p in found if isinstance(p, trimesh.Trimesh) and len(p.faces))
    if not parts:
        raise GymMaraError(f"the mesh {str(path)!r} has no triangles")
    for part in parts:
        if not np.isfinite(part.vertices).all():
            raise GymMaraError(f"the mesh {str(path)!r} has a vertex that is not finite")
    return parts
