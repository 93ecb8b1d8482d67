"""Checks of mesh files that trimesh, which reads them, does not make: it silently drops what it cannot read."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gym_mara.files import read_bytes
from gym_mara.robot.description.meshes.files import LARGEST_MESHES
from gym_mara.types import Floats


class Checked(NamedTuple):
    """A mesh file that was checked."""

    triangles: int | None = None
    """How many must be read; None if trimesh counts them itself."""
    frame: Floats | None = None
    """The transform (4, 4) from the file's frame and unit to the URDF's, m; None if they are the same."""
    content: bytes | None = None
    """What trimesh must read in place of the file."""
    others: Mapping[str, bytes] | None = None
    """The contents of the files to which it refers; None if they only have colours."""


def in_metres(unit: float) -> Floats:
    """The transform of a file with this unit, m."""
    return np.diag([unit, unit, unit, 1.0])


def check_obj(path: Path) -> Checked:
    """Check the vertices and faces of an OBJ file, whose unit is the metre.

    Raises:
        ValueError: a vertex is not finite, or a face has fewer than three vertices or a missing one.
    """
    vertices = last = triangles = 0
    text = read_bytes(path, LARGEST_MESHES).decode("utf-8", "replace").replace("\\\n", " ")
    for number, line in enumerate(text.splitlines(), 1):
        kind, *values = line.partition("#")[0].split() or [""]
        if kind == "v":
            vertices += 1
            if len(values) < 3 or not all(math.isfinite(float(value)) for value in values[:3]):
                raise ValueError(f"line {number} is no vertex of three finite numbers")
        elif kind == "f":
            corners = [int(value.partition("/")[0]) for value in values]
            if len(corners) < 3 or 0 in corners or min(corners) < -vertices:
                raise ValueError(f"line {number} is no face of three vertices or more")
            last = max(last, *corners)
            triangles += len(corners) - 2
    if last > vertices:
        raise ValueError(f"a face has vertex {last}, and there are {vertices}")
    return Checked(triangles)


def check_ply(path: Path) -> Checked:
    """Check that a PLY file in text, whose unit is the metre, has as many lines as its header says.

    Raises:
        ValueError: it has fewer.
    """
    header, end, body = read_bytes(path, LARGEST_MESHES).partition(b"end_header")
    if end and b"format ascii" in header:
        elements = sum(int(count) for count in re.findall(rb"element \w+ (\d+)", header))
        if len(body.split(b"\n")) - 1 < elements:
            raise ValueError(f"it is cut off: the header promises {elements} lines")
    return Checked()
