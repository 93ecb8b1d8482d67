"""Shapes without a volume are removed, with a warning, and collide on no backend."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest

from gym_mara.backends.dart.arm import DartArm
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Sphere
from tests.helpers import joint_xml, urdf_xml, write
from tests.robot.description.test_shapes import TETRAHEDRON

SPHERE = (
    '<collision><origin xyz="0.1 0 0"/><geometry><sphere radius="0.05"/></geometry></collision>'
)


def _stick(folder: Path, elements: str) -> Path:
    """A stick whose first link has these elements in place of its sphere."""
    write(folder / "part.stl", TETRAHEDRON)
    text = urdf_xml(joint_xml(0), joint_xml(1)).replace(SPHERE, elements, 1)
    return write(folder / "stick.urdf", text.replace("<robot", '<robot version="1.2"'))


def _element(shape: str, kind: str = "collision") -> str:
    return f"<{kind}><geometry>{shape}</geometry></{kind}>"


@pytest.mark.parametrize(
    "shape",
    [
        '<sphere radius="0"/>',
        '<sphere radius="1e-300"/>',
        '<box size="0.3 0 0.3"/>',
        '<cylinder radius="0.1" length="0"/>',
        '<cylinder radius="0" length="0.1"/>',
        '<capsule radius="0" length="0.1"/>',
        '<mesh filename="part.stl" scale="1 0 1"/>',
    ],
)
def test_a_shape_without_volume_is_removed_with_a_warning(tmp_path: Path, shape: str) -> None:
    path = _stick(tmp_path, _element(shape) + SPHERE)
    with pytest.warns(UserWarning, match=f"link link0: its <collision> {shape.split()[0]}"):
        robot = RobotModel.load(path, "link2")
    assert robot.shapes == (Sphere(0.05),) * 3
    arm = DartArm(robot)
    arm.reset(np.zeros(2))
    assert arm.contacts() == ()


def test_one_that_is_only_drawn_is_a_note(tmp_path: Path) -> None:
    path = _stick(tmp_path, _element('<box size="0 0 0"/>', "visual") + SPHERE)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        robot = RobotModel.load(path, "link2")
    assert {finding.severity for finding in robot.findings} == {"note"}
    assert robot.visual.shapes == robot.shapes


def test_a_capsule_of_length_zero_is_a_sphere(tmp_path: Path) -> None:
    robot = RobotModel.load(
        _stick(tmp_path, _element('<capsule radius="0.05" length="0"/>')), "link2"
    )
    assert robot.shapes == (Sphere(0.05),) * 3
    assert robot.findings == ()
