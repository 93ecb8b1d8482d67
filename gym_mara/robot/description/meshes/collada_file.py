"""Checks of Collada files, which trimesh reads with pycollada."""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from gym_mara.robot.description.meshes.checks import Checked, in_metres

_DRAWN = ("triangles", "polylist", "polygons", "tristrips", "trifans")
"""The elements that hold faces."""
_NOT_FINITE = re.compile("nan|inf", re.IGNORECASE)


def check_dae(path: Path) -> Checked:
    """Check that pycollada reads all faces of a Collada file, and that their vertices are finite.

    pycollada drops a part whose material is missing, with all its faces. A material is only a colour, so the part is read
    without it.

    Raises:
        ValueError: faces are not read, a vertex is not finite, or the file has no scene or has a skin.
    """
    import collada

    file = collada.Collada(str(path), ignore=[collada.DaeError])
    root = file.xmlnode.getroot()
    shapes = {shape.id: _surfaces(shape) for shape in file.geometries}
    positions = {
        element.get("source", "")[1:]
        for element in _of_kind(root, "input")
        if element.get("semantic") == "POSITION"
    }
    for element in root.iter():
        kind, own, url = _kind(element), element.get("id"), element.get("url", "")
        if kind == "geometry":
            held = sum(_kind(part) in _DRAWN for part in element.iter())
            if held > len(shapes.get(own, ())):
                errors = "; ".join(map(str, file.errors))
                raise ValueError(f"faces of geometry {own!r} are not read: {errors}")
        elif kind == "instance_geometry" and url[1:] not in shapes:
            raise ValueError(f"geometry {url!r} is missing")
        elif kind == "instance_controller":
            raise ValueError("it has a skin, <instance_controller>; export it without an armature")
        elif (
            kind == "source"
            and own in positions
            and _NOT_FINITE.search("".join(element.itertext()))
        ):
            # pycollada would take zero.
            raise ValueError(f"source {own!r} has a vertex that is not finite")
    triangles = {own: sum(map(_triangles, surfaces)) for own, surfaces in shapes.items()}
    return Checked(
        _drawn(root, triangles),
        in_metres(float(file.assetInfo.unitmeter or 1.0)),
        _without_missing(root, {material.id for material in file.materials}),
    )


def _kind(element: ElementTree.Element) -> str:
    """The name of an element, without its namespace."""
    return str(element.tag).rpartition("}")[2]


def _of_kind(root: ElementTree.Element, kind: str) -> Iterator[ElementTree.Element]:
    return (element for element in root.iter() if _kind(element) == kind)


def _surfaces(shape: Any) -> list[Any]:
    """The primitives of a geometry that have faces."""
    import collada

    kinds = (collada.triangleset.TriangleSet, collada.polylist.Polylist)
    return [primitive for primitive in shape.primitives if isinstance(primitive, kinds)]


def _triangles(surface: Any) -> int:
    polygons = getattr(surface, "vcounts", None)
    return len(surface) if polygons is None else int(np.maximum(polygons - 2, 0).sum())


def _drawn(root: ElementTree.Element, triangles: Mapping[str, int]) -> int:
    """The number of triangles in the file's scene.

    Args:
        root: the file's XML.
        triangles: of each geometry.
    """
    scenes = {scene.get("id"): scene for scene in _of_kind(root, "visual_scene")}
    nodes = {node.get("id"): node for node in _of_kind(root, "node")}
    shown = [instance.get("url", "")[1:] for instance in _of_kind(root, "instance_visual_scene")]
    if not shown or shown[0] not in scenes:
        raise ValueError("it has no <scene>")

    def count(node: ElementTree.Element) -> int:
        total = 0
        for child in node:
            kind, url = _kind(child), child.get("url", "")[1:]
            if kind == "instance_geometry":
                total += triangles[url]
            elif kind == "node":
                total += count(child)
            elif kind == "instance_node":
                if url not in nodes:
                    raise ValueError(f"node {url!r} is missing")
                total += count(nodes[url])
        return total

    return count(scenes[shown[0]])


def _without_missing(root: ElementTree.Element, materials: Collection[str]) -> bytes | None:
    """The file without the names of materials that are not read; None if all are."""
    missing = [
        (parent, instance)
        for parent in root.iter()
        for instance in parent
        if _kind(instance) == "instance_material"
        and instance.get("target", "")[1:] not in materials
    ]
    for parent, instance in missing:
        parent.remove(instance)
    if not missing:
        return None
    content = io.BytesIO()
    ElementTree.ElementTree(root).write(content, encoding="utf-8")
    return content.getvalue()
