"""Reads mesh files, each once in a process: units, node transforms and parts are those that the file describes."""

from __future__ import annotations

import io
import warnings
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import trimesh

from gym_mara.errors import GymMaraError
from gym_mara.files import plain_size
from gym_mara.robot.description.meshes.checks import Checked, check_obj, check_ply
from gym_mara.robot.description.meshes.collada_file import check_dae
from gym_mara.robot.description.meshes.gltf_file import check_gltf
from gym_mara.robot.description.shapes import Mesh

_KEPT = 256
"""The number of meshes that are kept for the next robot."""
_CHECKS: dict[str, Callable[[Path], Checked]] = {
    ".dae": check_dae,
    ".glb": check_gltf,
    ".gltf": check_gltf,
    ".obj": check_obj,
    ".ply": check_ply,
    ".stl": lambda path: Checked(),
}
"""What trimesh does not check: it drops what it cannot read of such a file."""
FORMATS = tuple(_CHECKS)


def read_mesh(path: Path, scale: tuple[float, float, float], *, convex: bool) -> Mesh:
    """The mesh of a file, or its convex hull.

    The axes are those of the file: like RViz, Gazebo and MoveIt, this ignores the up-axis of a Collada file, because robots
    are published so that they look right there. Only glTF's y, which points up, becomes z, as in RViz. A negative scale mirrors the mesh; its triangles still face outwards.

    Args:
        path: the file, in one of `FORMATS`.
        scale: along x, y and z.
        convex: whether to take the hull.

    Raises:
        GymMaraError: the format is not supported, the file is damaged, or it has no triangles.
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
    kind = path.suffix.lower()
    if kind not in _CHECKS:
        raise GymMaraError(
            f"the mesh {str(path)!r} has an unknown format; supported are {', '.join(FORMATS)}"
        )
    try:
        with warnings.catch_warnings():
            # NumPy 2.5 warns of pycollada, also where warnings are errors.
            warnings.filterwarnings("ignore", "Setting the shape", DeprecationWarning)
            checked = _CHECKS[kind](path)
            found = _read(path, kind, checked)
    except Exception as error:  # the readers of the formats raise whatever their parsers do
        reason = str(error) or type(error).__name__
        raise GymMaraError(f"the mesh {str(path)!r} cannot be read: {reason}") from error
    parts = tuple(p for p in found if isinstance(p, trimesh.Trimesh) and len(p.faces))
    triangles = sum(len(part.faces) for part in parts)
    if checked.triangles not in (None, triangles):
        raise GymMaraError(
            f"the mesh {str(path)!r} has {checked.triangles:,} triangles, of which {triangles:,} can be read; "
            "export it as .stl or .obj"
        )
    if not parts:
        raise GymMaraError(f"the mesh {str(path)!r} has no triangles, or is cut off")
    for part in parts:
        if part.faces.min() < 0 or part.faces.max() >= len(part.vertices):
            raise GymMaraError(f"the mesh {str(path)!r} has a triangle of a missing vertex")
        if not np.isfinite(part.vertices).all():
            raise GymMaraError(f"the mesh {str(path)!r} has a vertex that is not finite")
        part.process()
        if checked.frame is not None:
            part.apply_transform(checked.frame)
        _drop_degenerate(part)
    if not any(len(part.faces) for part in parts):
        raise GymMaraError(f"the mesh {str(path)!r} has only triangles without an area")
    return tuple(part for part in parts if len(part.faces))


def _drop_degenerate(part: trimesh.Trimesh) -> None:
    """Remove triangles without an area: engines have contacts with them far away, or none."""
    good = part.nondegenerate_faces()
    if not good.all():
        part.update_faces(good)
        part.remove_unreferenced_vertices()


def _read(path: Path, kind: str, checked: Checked) -> list[trimesh.Trimesh]:
    """What trimesh finds in a file that was checked."""
    source = path if checked.content is None else io.BytesIO(checked.content)
    # trimesh's processing would drop a vertex that is not finite, and its triangles.
    options = (
        {"process": False}
        if checked.others is None
        else {"process": False, "resolver": checked.others}
    )
    scene = trimesh.load_scene(source, file_type=kind[1:], **options)
    found: list[trimesh.Trimesh] = scene.dump()
    return found
