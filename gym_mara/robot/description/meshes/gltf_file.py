"""Checks of glTF files, .gltf and .glb, of which trimesh reads a part."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from gym_mara.files import plain_size, read_bytes
from gym_mara.robot.description.meshes.checks import Checked
from gym_mara.robot.description.meshes.files import LARGEST_MESHES

_UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""From glTF's y-up to the z-up of robots."""
_TRIANGLES, _STRIP, _FAN = 4, 5, 6
"""The modes of primitives that have faces; the others are points and lines."""
_FLOAT = 5126
_OF_APPEARANCE = ("KHR_materials", "KHR_texture", "EXT_texture", "KHR_lights")
_OF_SHAPE = ("draco", "meshopt", "quantization", "instancing")
"""Words in the names of extensions that change the faces."""

Json = dict[str, Any]


def check_gltf(path: Path) -> Checked:
    """Check that trimesh reads all triangles of a glTF file.

    glTF's unit is the metre and its y points up. Like RViz, Drake and Blender, this turns y to z. Gazebo does not.

    Raises:
        ValueError: the file is cut off, or has faces that trimesh does not read.
        GymMaraError: a file that it names is missing.
    """
    tree = _tree(path)
    if not str(tree["asset"]["version"]).startswith("2."):
        raise ValueError(f"it is glTF {tree['asset']['version']}; version 2 is supported")
    for name in [*tree.get("extensionsRequired", ()), *tree.get("extensionsUsed", ())]:
        required = name in tree.get("extensionsRequired", ())
        if any(word in name for word in _OF_SHAPE) or (
            required and not name.startswith(_OF_APPEARANCE)
        ):
            raise ValueError(f"the extension {name} is not supported; export it uncompressed")
    triangles = sum(
        _triangles(tree, primitive)
        for node in _nodes(tree)
        if "mesh" in node
        for primitive in tree["meshes"][node["mesh"]]["primitives"]
    )
    return Checked(triangles, _UPRIGHT, others=_buffers(path, tree))


def _tree(path: Path) -> Json:
    """The JSON of a file."""
    content = read_bytes(path, LARGEST_MESHES)
    if content[:4] == b"glTF":
        sizes = np.frombuffer(content[:20].ljust(20, b"\0"), "<u4")
        if len(content) < int(sizes[2]):
            raise ValueError("it is cut off")
        content = content[20 : 20 + int(sizes[3])]
    tree: Json = json.loads(content)
    return tree


def _nodes(tree: Json) -> Iterator[Json]:
    """The nodes of the file's scene.

    Raises:
        ValueError: there is no scene, or trimesh does not place a node rightly.
    """
    scenes, nodes = tree.get("scenes", []), tree.get("nodes", [])
    if not scenes:
        raise ValueError("it has no scene")
    waiting = list(scenes[tree.get("scene", 0)].get("nodes", ()))
    seen = set()
    while waiting:
        index = waiting.pop()
        if index in seen:
            raise ValueError(f"node {index} has two parents")
        seen.add(index)
        node = nodes[index]
        if "skin" in node or any(node.get("weights", ())):
            raise ValueError("it has a skin or a morph; export it without an armature")
        if "camera" in node and ("mesh" in node or "children" in node):
            raise ValueError("a camera has parts; export it without cameras")
        waiting += node.get("children", ())
        yield node


def _triangles(tree: Json, primitive: Json) -> int:
    """The number of triangles of a primitive.

    Raises:
        ValueError: trimesh does not read them rightly.
    """
    mode = primitive.get("mode", _TRIANGLES)
    if mode in (_STRIP, _FAN):
        raise ValueError("it has triangle strips or fans; export triangles")
    if mode != _TRIANGLES:
        return 0
    accessors = tree["accessors"]
    corners = positions = accessors[primitive["attributes"]["POSITION"]]
    if positions["componentType"] != _FLOAT:
        raise ValueError("its vertices are not of type float; export it uncompressed")
    if "indices" in primitive:
        corners = accessors[primitive["indices"]]
    for accessor in (positions, corners):
        if "sparse" in accessor or "bufferView" not in accessor:
            raise ValueError("it has sparse accessors, which are not supported")
    if corners["count"] % 3:
        raise ValueError(f"a triangle is cut off: there are {corners['count']} corners")
    return int(corners["count"]) // 3


def _buffers(path: Path, tree: Json) -> dict[str, bytes]:
    """The contents of the files that a file names.

    Raises:
        ValueError: one is too short.
        GymMaraError: one is missing.
    """
    contents = {}
    for buffer in tree.get("buffers", ()):
        name = buffer.get("uri", "data:")
        if name.startswith("data:"):
            continue
        file = path.parent / unquote(name)
        if plain_size(file) < buffer["byteLength"]:
            raise ValueError(f"{str(file)!r} is cut off")
        contents[name] = read_bytes(file, LARGEST_MESHES)
    return contents
