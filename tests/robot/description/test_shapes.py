"""The shapes of links: what a URDF describes is what the engines are given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere
from tests.helpers import joint_xml, urdf_xml, write

TETRAHEDRON = """solid t
facet normal 0 0 -1
outer loop
vertex 0 0 0
vertex 0 1 0
vertex 1 0 0
endloop
endfacet
facet normal 0 -1 0
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 0 1
endloop
endfacet
facet normal -1 0 0
outer loop
vertex 0 0 0
vertex 0 0 1
vertex 0 1 0
endloop
endfacet
facet normal 1 1 1
outer loop
vertex 1 0 0
vertex 0 1 0
vertex 0 0 1
endloop
endfacet
endsolid t
"""


def _robot(folder: Path, shape: str, checking: str = "") -> RobotModel:
    """A stick whose links have this shape; `checking` is "convex" or "capsule" where Pinocchio is to change it."""
    text = urdf_xml(joint_xml(0)).replace('<sphere radius="0.05"/>', shape)
    if checking:
        tag = f'<collision_checking><{checking} name="part"/></collision_checking>'
        text = text.replace("<collision>", f'{tag}<collision name="part">')
    return RobotModel.load(write(folder / "stick.urdf", text), "link1")


def _shape(robot: RobotModel) -> Shape:
    return robot.shapes[0]


def _mesh_file(folder: Path) -> Path:
    return write(folder / "tetrahedron.stl", TETRAHEDRON)


def test_a_box(tmp_path: Path) -> None:
    shape = _shape(_robot(tmp_path, '<box size="0.1 0.2 0.3"/>'))
    assert isinstance(shape, Box)
    np.testing.assert_array_equal(shape.size, [0.1, 0.2, 0.3])


def test_round_shapes(tmp_path: Path) -> None:
    cylinder = '<cylinder radius="0.1" length="0.5"/>'
    assert _shape(_robot(tmp_path, '<sphere radius="0.1"/>')) == Sphere(0.1)
    assert _shape(_robot(tmp_path, cylinder)) == Cylinder(0.1, 0.5)
    assert _shape(_robot(tmp_path, cylinder, "capsule")) == Capsule(0.1, 0.5)


@pytest.mark.parametrize("checking", ["", "convex"])
def test_a_mesh_has_its_file_and_scaled_vertices(tmp_path: Path, checking: str) -> None:
    path = _mesh_file(tmp_path)
    shape = _shape(_robot(tmp_path, f'<mesh filename="{path}" scale="2 1 0.5"/>', checking))
    assert isinstance(shape, Mesh)
    assert shape.path == str(path)
    assert shape.convex == (checking == "convex")
    np.testing.assert_array_equal(shape.vertices.max(axis=0), [2.0, 1.0, 0.5])
    assert shape.faces.shape == (4, 3)
