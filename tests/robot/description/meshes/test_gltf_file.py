"""glTF files, .gltf and .glb: y is up, nothing is lost, and what cannot be read is an error that says why."""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot.description.meshes.reader import read_mesh
from gym_mara.robot.description.shapes import Mesh

CORNERS = np.array([(0, 0, 0), (1, 0, 0), (0, 2, 0), (0, 0, 3)], np.float32)
FACES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)], np.uint16)
DATA = CORNERS.tobytes() + FACES.tobytes()
Json = dict[str, Any]


def _tree(uri: str | None = None) -> Json:
    """A tetrahedron with corners at 1 along x, 2 along y and 3 along z."""
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 12, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 0, "byteOffset": 48, "byteLength": 24},
        ],
        "buffers": [{"byteLength": 72} | ({"uri": uri} if uri else {})],
    }


def _glb(tree: Json) -> bytes:
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(DATA), 0x004E4942) + DATA
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _write(path: Path, content: bytes | Json) -> Path:
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
    return path


def _read(path: Path) -> Mesh:
    return read_mesh(path, (1.0, 1.0, 1.0), convex=False)


def _assert_tetrahedron(mesh: Mesh) -> None:
    """y has become z, and z has become -y."""
    assert len(mesh.faces) == 4
    np.testing.assert_allclose(mesh.vertices.min(axis=0), (0, -3, 0), atol=1e-12)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), (1, 0, 2), atol=1e-12)
    assert np.linalg.det(mesh.vertices[mesh.faces]).sum() / 6.0 == pytest.approx(1.0)


def test_a_binary_file(tmp_path: Path) -> None:
    _assert_tetrahedron(_read(_write(tmp_path / "a.glb", _glb(_tree()))))


@pytest.mark.parametrize("name", ["a.bin", "a b.bin", "../a.bin"])
def test_a_file_with_its_data_in_another(tmp_path: Path, name: str) -> None:
    folder = tmp_path / "meshes"
    folder.mkdir()
    (folder / name).write_bytes(DATA)
    _assert_tetrahedron(_read(_write(folder / "a.gltf", _tree(name.replace(" ", "%20")))))


def test_a_file_with_its_data_inside(tmp_path: Path) -> None:
    uri = "data:application/octet-stream;base64," + base64.b64encode(DATA).decode()
    _assert_tetrahedron(_read(_write(tmp_path / "a.GLTF", _tree(uri))))


def test_nodes_place_their_parts(tmp_path: Path) -> None:
    tree = _tree()
    tree["scenes"][0]["nodes"] = [0, 1]
    tree["nodes"] = [
        {"mesh": 0, "name": "same"},
        {"scale": [2, 2, 2], "children": [2], "name": "same"},
        {"mesh": 0, "translation": [5, 0, 0], "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]},
    ]
    mesh = _read(_write(tmp_path / "a.glb", _glb(tree)))
    assert len(mesh.faces) == 8
    np.testing.assert_allclose(mesh.vertices.min(axis=0), (0, -6, 0), atol=1e-6)
    np.testing.assert_allclose(mesh.vertices.max(axis=0), (10, 0, 2), atol=1e-6)


def test_points_and_lines_are_ignored(tmp_path: Path) -> None:
    tree = _tree()
    tree["meshes"][0]["primitives"].append({"mode": 0, "attributes": {"POSITION": 0}})
    _assert_tetrahedron(_read(_write(tmp_path / "a.glb", _glb(tree))))


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.gltf", _tree("gone.bin"))
    with pytest.raises(GymMaraError, match=r"a\.gltf.*gone\.bin'.*no such file"):
        _read(path)


def _set(*keys: str | int, value: Any) -> Callable[[Json], None]:
    def change(tree: Json) -> None:
        held: Any = tree
        for key in keys[:-1]:
            held = held[key]
        held[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (_set("asset", "version", value="1.0"), "glTF 1.0"),
        (_set("extensionsUsed", value=["KHR_draco_mesh_compression"]), "uncompressed"),
        (_set("extensionsRequired", value=["SOME_thing"]), "SOME_thing"),
        (_set("meshes", 0, "primitives", 0, "mode", value=5), "strips"),
        (_set("accessors", 0, "componentType", value=5122), "float"),
        (_set("accessors", 0, "sparse", value={}), "sparse"),
        (_set("accessors", 1, "count", value=11), "11 corners"),
        (_set("accessors", 1, "count", value=120), "cannot be read"),
        (_set("nodes", 0, "skin", value=0), "armature"),
        (_set("nodes", 0, "camera", value=0), "camera"),
        (_set("nodes", 0, "children", value=[0]), "two parents"),
        (_set("nodes", value=[{}]), "no triangles"),
        (_set("scenes", value=[]), "no scene"),
        (_set("scenes", 0, "nodes", value=[7]), "cannot be read"),
    ],
)
def test_what_cannot_be_read_is_an_error(
    tmp_path: Path, change: Callable[[Json], None], reason: str
) -> None:
    tree = _tree()
    change(tree)
    path = _write(tmp_path / "a.glb", _glb(tree))
    with pytest.raises(GymMaraError, match=reason) as raised:
        _read(path)
    assert str(path) in str(raised.value)


@pytest.mark.parametrize("length", [10, 100, 500, -40])
def test_a_file_that_is_cut_off_is_an_error(tmp_path: Path, length: int) -> None:
    path = _write(tmp_path / "a.glb", _glb(_tree())[:length])
    with pytest.raises(GymMaraError, match=r"a\.glb.*cut off"):
        _read(path)


def test_data_that_is_cut_off_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.bin").write_bytes(DATA[:-1])
    with pytest.raises(GymMaraError, match=r"a\.bin' is cut off"):
        _read(_write(tmp_path / "a.gltf", _tree("a.bin")))
