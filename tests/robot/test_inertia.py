"""The inertias that bodies without one get from their shapes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from gym_mara.robot import RobotModel
from gym_mara.robot.fingerprint import fingerprint
from tests.helpers import write
from tests.robot.arms import COLLISION, INERTIA, INERTIAL, TOOL, arm, arm_file


def _of(tmp_path: Path, geometry: str, mass: float = 2.0) -> tuple[float, list[float], list[float]]:
    """Mass, centre of mass and principal moments of l1, with a shape 0.15 m above its joint and no inertia."""
    shape = f'<collision><origin xyz="0 0 0.15"/><geometry>{geometry}</geometry></collision>'
    text = arm(inertial="", collision=shape).replace("<robot ", '<robot version="1.2" ')
    urdf = arm_file(tmp_path, text)
    inertia = RobotModel.load(urdf, TOOL, default_mass=mass).model.inertias[1]
    moments = np.linalg.eigvalsh(inertia.inertia)
    return inertia.mass, inertia.lever.tolist(), moments.tolist()


@pytest.mark.parametrize(
    ("geometry", "moments"),
    [
        (
            '<box size="0.06 0.12 0.2"/>',
            [(0.06**2 + 0.12**2) / 6, (0.06**2 + 0.2**2) / 6, (0.12**2 + 0.2**2) / 6],
        ),
        ('<sphere radius="0.1"/>', [0.008, 0.008, 0.008]),
        ('<cylinder radius="0.1" length="0.4"/>', [0.01, 0.19 / 6, 0.19 / 6]),
        ('<capsule radius="0.1" length="0.001"/>', pytest.approx([0.008] * 3, rel=0.02)),
    ],
)
def test_a_primitive_has_its_textbook_inertia(
    tmp_path: Path, geometry: str, moments: list[float]
) -> None:
    mass, lever, found = _of(tmp_path, geometry)
    assert mass == pytest.approx(2.0)
    np.testing.assert_allclose(lever, [0.0, 0.0, 0.15], atol=1e-12)
    assert found == (pytest.approx(moments) if isinstance(moments, list) else moments)


@pytest.mark.parametrize("closed", [True, False])
def test_a_mesh_has_the_inertia_of_its_volume_or_of_its_hull(tmp_path: Path, closed: bool) -> None:
    mesh = trimesh.creation.box((0.06, 0.12, 0.2))
    if not closed:
        mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    mesh.export(tmp_path / "part.stl")
    mass, lever, moments = _of(tmp_path, '<mesh filename="part.stl"/>')
    box = _of(tmp_path, '<box size="0.06 0.12 0.2"/>')
    assert mass == pytest.approx(box[0])
    assert lever == pytest.approx(box[1], abs=1e-9)
    assert moments == pytest.approx(box[2], rel=1e-6)


def test_a_flat_mesh_has_an_inertia(tmp_path: Path) -> None:
    write(tmp_path / "flat.obj", "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nf 1 2 3\n")
    mass, _, moments = _of(tmp_path, '<mesh filename="flat.obj"/>')
    assert mass == pytest.approx(2.0)
    assert 0.0 < moments[0] <= moments[2] <= moments[0] + moments[1] + 1e-12


def test_shapes_share_the_mass_by_their_volume(tmp_path: Path) -> None:
    one, other = (
        f'<collision><origin xyz="0 0 {z}"/><geometry><box size="0.1 0.1 {length}"/></geometry></collision>'
        for z, length in ((0.05, 0.1), (0.25, 0.3))
    )
    urdf = arm_file(tmp_path, arm(inertial="", collision=one + other))
    whole = RobotModel.load(urdf, TOOL, default_mass=2.0).model.inertias[1]
    urdf = arm_file(
        tmp_path,
        arm(
            inertial="",
            collision=COLLISION.replace("0.15", "0.2").replace("0.06 0.06 0.22", "0.1 0.1 0.4"),
        ),
    )
    box = RobotModel.load(urdf, TOOL, default_mass=2.0).model.inertias[1]
    assert whole.isApprox(box)


def test_a_body_without_a_shape_is_a_ball(tmp_path: Path) -> None:
    urdf = arm_file(tmp_path, arm(inertial=""))
    text = urdf.read_text().replace(COLLISION, "", 1)
    ball = RobotModel.load(write(urdf, text), TOOL, default_mass=2.0).model.inertias[1]
    np.testing.assert_allclose(ball.inertia, 0.4 * 2.0 * 0.05**2 * np.eye(3))


def test_a_body_with_a_mass_keeps_it(tmp_path: Path) -> None:
    nothing = INERTIA.replace("0.01", "0").replace("0.005", "0")
    urdf = arm_file(
        tmp_path, arm(inertial=INERTIAL.replace(INERTIA, nothing).replace("0.15", "0.1"))
    )
    inertia = RobotModel.load(urdf, TOOL, default_mass=5.0).model.inertias[1]
    assert inertia.mass == 1.0
    np.testing.assert_allclose(inertia.lever, [0.0, 0.0, 0.1])
    assert np.linalg.eigvalsh(inertia.inertia)[0] > 1e-4


def test_bodies_with_mass_and_inertia_do_not_change(tmp_path: Path) -> None:
    urdf = arm_file(tmp_path)
    given = RobotModel.load(urdf, TOOL, default_mass=5.0)
    assert fingerprint(given) == fingerprint(RobotModel.load(urdf, TOOL))


def test_another_default_mass_is_another_arm(tmp_path: Path) -> None:
    urdf = arm_file(tmp_path, arm(inertial=""))
    one, other = (fingerprint(RobotModel.load(urdf, TOOL, default_mass=m)) for m in (1.0, 2.0))
    assert one != other
