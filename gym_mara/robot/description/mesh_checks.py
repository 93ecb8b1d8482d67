"""Checks of mesh files that the library which reads them does not make: it silently drops what it cannot read.

Each check returns the length of the file's unit, m.
"""

from __future__ import annotations

import math
import re
from pathlib import Path

_DRAWN = ("triangles", "polylist", "polygons", "tristrips", "trifans")
"""Collada's elements that hold faces."""
_NOT_FINITE = re.compile("nan|inf", re.IGNORECASE)


def check_dae(path: Path) -> float:
    """Check that pycollada reads all faces of a Collada file, and that their vertices are finite.

    Raises:
        ValueError: it does not, or they are not.
    """
    import collada

    file = collada.Collada(str(path), ignore=[collada.DaeError])
    faces = {geometry.id: len(geometry.primitives) for geometry in file.geometries}
    elements = [(str(e.tag).rpartition("}")[2], e) for e in file.xmlnode.iter()]
    positions = {
        element.get("source", "")[1:]
        for kind, element in elements
        if kind == "input" and element.get("semantic") == "POSITION"
    }
    for kind, element in elements:
        own = element.get("id")
        if kind == "geometry":
            held = sum(str(part.tag).rpartition("}")[2] in _DRAWN for part in element.iter())
            if held > faces.get(own, 0):
                errors = "; ".join(map(str, file.errors))
                raise ValueError(f"faces of geometry {own!r} are not read: {errors}")
        elif kind == "instance_geometry" and element.get("url", "")[1:] not in faces:
            raise ValueError(f"geometry {element.get('url')!r} is missing")
        elif (
            kind == "source"
            and own in positions
            and _NOT_FINITE.search("".join(element.itertext()))
        ):
            # pycollada would take zero.
            raise ValueError(f"source {own!r} has a vertex that is not finite")
    return float(file.assetInfo.unitmeter or 1.0)


def check_obj(path: Path) -> float:
    """Check the vertices and faces of an OBJ file, whose unit is the metre.

    Raises:
        ValueError: a vertex is not finite, or a face has fewer than three vertices or a missing one.
    """
    vertices = last = 0
    text = path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
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
    if last > vertices:
        raise ValueError(f"a face has vertex {last}, and there are {vertices}")
    return 1.0


def check_ply(path: Path) -> float:
    """Check that a PLY file in text, whose unit is the metre, has as many lines as its header says.

    Raises:
        ValueError: it has fewer.
    """
    header, end, body = path.read_bytes().partition(b"end_header")
    if end and b"format ascii" in header:
        elements = sum(int(count) for count in re.findall(rb"element \w+ (\d+)", header))
        if len(body.split(b"\n")) - 1 < elements:
            raise ValueError(f"it is cut off: the header promises {elements} lines")
    return 1.0
