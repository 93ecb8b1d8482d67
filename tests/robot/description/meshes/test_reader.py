"""Mesh files: units, transforms and parts are those of the file, and a damaged file is an error."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gym_mara.errors import GymMaraError
from gym_mara.robot.description.meshes.reader import read_mesh
from gym_mara.robot.description.shapes import Mesh
from tests.helpers import Floats, write

BOX = trimesh.creation.box((1.0, 2.0, 3.0))
STL = BOX.export(file_type="stl")
STL_TEXT = BOX.export(file_type="stl_ascii")
OBJ = BOX.export(file_type="obj")
PLY = BOX.export(file_type="ply", encoding="ascii").decode()
NODE = '<node><instance_geometry url="#g"/></node>'
SCENE = '<scene><instance_visual_scene url="#s"/></scene>'
LINES = '<lines count="1"><input semantic="VERTEX" source="#v" offset="0"/><p>0 1</p></lines>'
TWO_PARTS = """v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
usemtl one
f 1 3 2
f 1 2 4
f 1 4 3
f 2 3 4
v 5 0 0
v 6 0 0
v 5 1 0
v 5 0 1
usemtl two
f 5 7 6
f 5 6 8
f 5 8 7
f 6 7 8
"""


def dae(
    unit: str = "1", up: str = "Z_UP", nodes: str = NODE, points: str = "0 0 0 1 0 0 0 2 0 0 0 3"
) -> str:
    """A tetrahedron with corners at 1 along x, 2 along y and 3 along z."""
    return f"""<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="u" meter="{unit}"/><up_axis>{up}</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">{points}</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/><p>0 2 1 0 1 3 0 3 2 1 2 3</p></triangles>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s">{nodes}</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


def _read(path: Path, scale: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Mesh:
    return read_mesh(path, scale, convex=False)


def _volume(mesh: Mesh) -> float:
    """Of a closed mesh, m³; negative if its triangles face inwards."""
    corners = mesh.vertices[mesh.faces]
    return float(np.linalg.det(corners).sum() / 6.0)


def _bounds(mesh: Mesh) -> Floats:
    return np.array([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])


@pytest.mark.parametrize("name", ["box.stl", "text.stl", "box.obj", "box.ply", "UPPER.STL"])
def test_every_format_gives_the_same_box(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "text.stl":
        write(path, STL_TEXT)
    else:
        BOX.export(path, file_type=path.suffix[1:].lower())
    mesh = _read(path)
    np.testing.assert_allclose(_bounds(mesh), BOX.bounds)
    assert _volume(mesh) == pytest.approx(6.0)
    assert len(mesh.vertices) == 8


@pytest.mark.parametrize(
    ("text", "low", "high"),
    [
        pytest.param(dae(), (0, 0, 0), (1, 2, 3), id="metres"),
        pytest.param(dae("0.001"), (0, 0, 0), (0.001, 0.002, 0.003), id="millimetres"),
        # As in RViz, Gazebo and MoveIt.
        pytest.param(dae(up="Y_UP"), (0, 0, 0), (1, 2, 3), id="another up-axis"),
        pytest.param(
            dae(
                "0.01",
                nodes=f"<node><translate>10 0 0</translate><node><rotate>0 0 1 90</rotate><scale>2 2 2</scale>{NODE}</node></node>",
            ),
            (0.06, 0, 0),
            (0.1, 0.02, 0.06),
            id="nodes within nodes",
        ),
        pytest.param(
            dae(nodes=f"<node><scale>-1 1 1</scale>{NODE}</node>"),
            (-1, 0, 0),
            (0, 2, 3),
            id="mirrored",
        ),
        pytest.param(
            dae(nodes=f"{NODE}<node><translate>5 0 0</translate>{NODE}</node>"),
            (0, 0, 0),
            (6, 2, 3),
            id="twice",
        ),
    ],
)
def test_a_collada_file(
    tmp_path: Path, text: str, low: tuple[float, ...], high: tuple[float, ...]
) -> None:
    mesh = _read(write(tmp_path / "part.dae", text))
    np.testing.assert_allclose(_bounds(mesh), [low, high], atol=1e-7)
    assert _volume(mesh) > 0.0


BOUND = NODE.replace(
    "/></node>",
    '><bind_material><technique_common><instance_material symbol="s" target="#m"/></technique_common></bind_material>'
    "</instance_geometry></node>",
)
MATERIAL = """<library_effects><effect id="e"><profile_COMMON><technique sid="t"><lambert><diffuse><color>1 0 0 1</color></diffuse>
</lambert></technique></profile_COMMON></effect></library_effects>
<library_materials><material id="m"><instance_effect url="#e"/></material></library_materials>"""


@pytest.mark.parametrize("target", ["#gone", "gone", "", "#m"])
def test_a_part_without_its_material_is_read(tmp_path: Path, target: str) -> None:
    """A material is only a colour. Exporters name materials that they do not write."""
    other = f"<node><translate>5 0 0</translate>{BOUND}</node>"
    text = dae(nodes=BOUND.replace("#m", target) + other)
    if target != "#m":
        text = text.replace("<library_geometries>", f"{MATERIAL}<library_geometries>")
    text = text.replace('<triangles count="4">', '<triangles count="4" material="s">')
    mesh = _read(write(tmp_path / "part.dae", text))
    assert len(mesh.faces) == 8
    np.testing.assert_allclose(_bounds(mesh), [(0, 0, 0), (6, 2, 3)])
    if target != "#m":
        assert [part.visual.kind for part in mesh.parts].count("texture") == 1


def test_a_node_of_the_library_is_read_where_it_is_named(tmp_path: Path) -> None:
    node = f'<library_nodes><node id="n">{NODE}</node></library_nodes>'
    uses = '<node><instance_node url="#n"/></node><node><translate>5 0 0</translate><instance_node url="#n"/></node>'
    text = dae(nodes=uses).replace("<library_visual_scenes>", f"{node}<library_visual_scenes>")
    np.testing.assert_allclose(
        _bounds(_read(write(tmp_path / "a.dae", text))), [(0, 0, 0), (6, 2, 3)]
    )


def test_triangles_without_an_area_are_dropped(tmp_path: Path) -> None:
    path = write(tmp_path / "parts.obj", TWO_PARTS + "f 1 1 2\nf 3 3 3\nv 2 0 0\nf 1 2 9\n")
    mesh = _read(path)
    assert len(mesh.faces) == 8
    np.testing.assert_array_equal(_bounds(mesh), [[0, 0, 0], [6, 1, 1]])
    with pytest.raises(GymMaraError, match="only triangles without an area"):
        _read(write(tmp_path / "line.obj", "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"))


def test_triangles_that_are_lost_are_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write(tmp_path / "parts.obj", TWO_PARTS)
    whole = trimesh.Scene.dump
    monkeypatch.setattr(trimesh.Scene, "dump", lambda scene: whole(scene)[1:])
    with pytest.raises(GymMaraError, match=r"has 8 triangles, of which 4 can be read"):
        _read(path)


def test_an_obj_of_two_materials_has_both_parts(tmp_path: Path) -> None:
    mesh = _read(write(tmp_path / "parts.obj", TWO_PARTS))
    assert len(mesh.parts) == 2
    np.testing.assert_array_equal(_bounds(mesh), [[0, 0, 0], [6, 1, 1]])
    assert _volume(mesh) == pytest.approx(2 / 6)


@pytest.mark.parametrize("scale", [(-1.0, 1.0, 1.0), (1.0, -2.0, 1.0), (-1.0, -1.0, -0.5)])
def test_a_mirrored_mesh_still_faces_outwards(
    tmp_path: Path, scale: tuple[float, float, float]
) -> None:
    mesh = _read(write(tmp_path / "part.dae", dae()), scale)
    assert _volume(mesh) == pytest.approx(abs(np.prod(scale)))
    np.testing.assert_allclose(sorted(_bounds(mesh)[:, 0]), sorted((0.0, scale[0])))


def test_a_hull_fills_the_hollows_and_faces_outwards(tmp_path: Path) -> None:
    path = write(tmp_path / "parts.obj", TWO_PARTS)
    hull = read_mesh(path, (1.0, 1.0, 1.0), convex=True)
    assert hull.convex
    assert _volume(hull) > 5 * _volume(_read(path))


def test_the_hull_of_a_flat_mesh_is_the_mesh(tmp_path: Path) -> None:
    path = write(tmp_path / "flat.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
    assert not read_mesh(path, (1.0, 1.0, 1.0), convex=True).convex


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("a.stl", STL[:-100], "cut off"),
        ("a.stl", STL_TEXT[: len(STL_TEXT) // 2], "cut off"),
        ("a.stl", STL_TEXT[: STL_TEXT.rindex("facet normal")], "cut off"),
        ("a.stl", b"", "no triangles"),
        ("a.stl", STL[:96] + struct.pack("<f", np.nan) + STL[100:], "not finite"),
        ("a.obj", OBJ[: int(0.8 * len(OBJ))], "line 11"),
        ("a.obj", OBJ + "f 1 2 99\n", "vertex 99"),
        ("a.obj", OBJ + "f 0 1 2\n", "line"),
        ("a.obj", "v nan 0 0\n" + OBJ, "line 1"),
        ("a.obj", "hello", "no triangles"),
        ("a.ply", PLY[:-30], "cut off"),
        ("a.ply", PLY.replace("-0.50000000", "nan", 1), "not finite"),
        ("a.ply", PLY.replace("\n3 ", "\n3 9", 1), "missing vertex"),
        ("a.dae", dae()[:700], "XML"),
        ("a.dae", dae(points="0 0 0 NaN 0 0 0 2 0 0 0 3"), "not finite"),
        ("a.dae", dae().replace("<p>0 2", "<p>9 2"), "maxindex=9"),
        ("a.dae", dae(nodes=NODE + NODE.replace("#g", "#other")), "#other"),
        ("a.dae", dae().replace(SCENE, ""), "no <scene>"),
        ("a.dae", dae(nodes='<node><instance_node url="#n"/></node>'), "node 'n' is missing"),
        ("a.dae", dae(nodes='<node><instance_controller url="#n"/></node>'), "armature"),
        (
            "a.dae",
            dae().replace("<triangles", f"{LINES}<triangles").replace("<p>0 2", "<p>9 2"),
            "maxindex=9",
        ),
        ("a.off", "OFF", r"supported are .dae, .glb, .gltf, .obj, .ply, .stl"),
        ("a", STL, "supported are"),
    ],
    ids=lambda value: value if isinstance(value, str) and len(value) < 20 else "",
)
def test_a_damaged_file_is_an_error_that_names_it(
    tmp_path: Path, name: str, content: str | bytes, reason: str
) -> None:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(GymMaraError, match=reason) as raised:
        _read(path)
    assert str(path) in str(raised.value)
