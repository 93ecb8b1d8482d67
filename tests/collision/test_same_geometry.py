"""Every engine has the same geometry of meshes: Coal, python-fcl, DART and MuJoCo agree wherever Coal sees no contact nearby."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gym_mara.backends.dart.arm import DartArm
from gym_mara.backends.mujoco.backend import MujocoBackend
from gym_mara.collision import make_checker
from gym_mara.rendering.scene import Scene
from gym_mara.robot import RobotModel
from gym_mara.testing import uniform_q
from tests.helpers import Floats, Mask, write
from tests.robot.description.meshes.test_reader import TWO_PARTS, dae
from tests.shape_pairs import PRIMITIVES, held, wrong

ENGINES = ("fcl", "dart with fcl", "dart with dart", "mujoco")
MESHES = {
    "concave": '<mesh filename="concave.stl"/>',
    "two parts": '<mesh filename="parts.obj" scale="0.3 0.35 0.2"/>',
    "millimetres": '<mesh filename="part.dae" scale="200 150 120"/>',
    "mirrored": '<mesh filename="concave.stl" scale="-1 1.5 1"/>',
}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with the meshes: an L, two tetrahedra, and one in millimetres."""
    legs = [trimesh.creation.box(size) for size in ((0.3, 0.1, 0.1), (0.1, 0.1, 0.3))]
    legs[0].apply_translation((0.1, 0.0, 0.0))
    legs[1].apply_translation((0.0, 0.0, 0.1))
    trimesh.util.concatenate(legs).export(tmp_path / "concave.stl")
    write(tmp_path / "parts.obj", TWO_PARTS)
    write(tmp_path / "part.dae", dae("0.001"))
    return tmp_path


def _check(engine: str, robot: RobotModel, q: Floats) -> Mask:
    name, _, detector = engine.partition(" with ")
    if name == "mujoco":
        backend = MujocoBackend(robot, len(q))
        backend.reset(q)
        return backend.state.collided
    if name != "dart":
        return make_checker(name, robot).check(q)
    arm, found = DartArm(robot, detector=detector), []
    for row in q:
        arm.reset(row)
        found.append(bool(arm.contacts()))
    return np.array(found)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("other", [*MESHES, *PRIMITIVES])
@pytest.mark.parametrize("convex_hulls", [False, True], ids=["meshes", "hulls"])
def test_engines_agree_on_a_mesh(folder: Path, engine: str, other: str, convex_hulls: bool) -> None:
    shapes = PRIMITIVES | MESHES
    for mesh in MESHES.values():
        robot = held(folder, mesh, shapes[other], convex_hulls=convex_hulls)
        coal = make_checker("coal", robot).check
        assert wrong(robot, coal, functools.partial(_check, engine, robot), 80) == {}


def _arm(folder: Path, shape: str) -> RobotModel:
    """An arm of three links that have the same shape, 0.3 m apart."""
    link = f'<collision><origin xyz="-0.03 -0.03 0.05"/><geometry>{shape}</geometry></collision>'
    text = f'<link name="l0">{link}</link>'
    for number in range(1, 4):
        text += (
            f'<link name="l{number}">{link}</link><joint name="j{number}" type="revolute">'
            f'<parent link="l{number - 1}"/><child link="l{number}"/><origin xyz="0 0 0.3"/><axis xyz="0 1 0"/>'
            '<limit lower="-2.6" upper="2.6" effort="9" velocity="1"/></joint>'
        )
    path = write(folder / "arm.urdf", f'<robot name="a">{text}</robot>')
    return RobotModel.inspect(path, "l3", default_mass=1.0)


@pytest.mark.parametrize("engine", ["coal", *ENGINES])
def test_a_mesh_in_millimetres_is_the_same_as_one_in_metres(folder: Path, engine: str) -> None:
    write(folder / "metres.dae", dae(points="0 0 0 0.06 0 0 0 0.06 0 0 0 0.3"))
    write(folder / "millimetres.dae", dae("0.001", points="0 0 0 60 0 0 0 60 0 0 0 300"))
    flags = []
    for name in ("metres", "millimetres"):
        robot = _arm(folder, f'<mesh filename="{name}.dae"/>')
        assert robot.extent < 1.5
        flags.append(_check(engine, robot, uniform_q(robot, 100, 0)))
    assert flags[0].any()
    assert not flags[0].all()
    np.testing.assert_array_equal(flags[0], flags[1])


@pytest.mark.parametrize("engine", ["coal", *ENGINES])
def test_both_parts_of_a_mesh_collide(folder: Path, engine: str) -> None:
    """Where the parts, which are 0.4 m apart, hold the box between them, and where one of them holds it."""
    mesh = '<mesh filename="parts.obj" scale="0.1 0.1 0.1"/>'
    robot = held(folder, '<box size="0.1 0.1 0.1"/>', mesh)
    q = np.zeros((3, 6))
    q[:, 0] = -0.02, -0.3, -0.52
    assert _check(engine, robot, q).tolist() == [True, False, True]


POST = np.array([(0.25, -0.1, -0.08), (0.27, 0.1, 1.92)])
"""The least and the largest corner of a box, m."""
BAR = np.array([(x, y, z) for x in (0.15, 0.25) for y in (-0.02, 0.02) for z in (-0.02, 0.02)])
"""The corners of the second part of the mesh below, in the frame of the tool, m."""


def _arm_with_a_bar(folder: Path) -> RobotModel:
    """An arm whose tool is a mesh of two materials, a cube and a bar, before a post that the bar reaches."""
    text = ""
    for part, corners in enumerate((np.sign(BAR - (0.2, 0, 0)) * 0.01, BAR)):
        box = trimesh.convex.convex_hull(corners)
        text += "".join(f"v {x} {y} {z}\n" for x, y, z in box.vertices) + f"usemtl m{part}\n"
        text += "".join(f"f {a} {b} {c}\n" for a, b, c in box.faces + 8 * part + 1)
    write(folder / "tool.obj", text)
    size, centre = POST[1] - POST[0], POST.mean(axis=0)
    links = f"""<link name="base"/><link name="l1"/><link name="l2"/><link name="l3"/>
        <link name="tool"><collision><geometry><mesh filename="tool.obj"/></geometry></collision></link>
        <link name="post"><collision><geometry><box size="{size[0]} {size[1]} {size[2]}"/></geometry></collision></link>
        <joint name="jp" type="fixed"><parent link="base"/><child link="post"/>
        <origin xyz="{centre[0]} {centre[1]} {centre[2]}"/></joint>
        <joint name="jt" type="fixed"><parent link="l3"/><child link="tool"/><origin xyz="0 0 0.3"/></joint>"""
    joints = (("base", "l1", 0.02, "0 0 1"), ("l1", "l2", 0.3, "0 1 0"), ("l2", "l3", 0.3, "0 1 0"))
    for parent, child, height, axis in joints:
        links += f"""<joint name="{child}" type="revolute"><parent link="{parent}"/><child link="{child}"/>
            <origin xyz="0 0 {height}"/><axis xyz="{axis}"/><limit lower="-2" upper="2" effort="50" velocity="2"/></joint>"""
    # The bar touches the post at home; with an SRDF the pair stays checked.
    srdf = '<robot name="a"><disable_collisions link1="base" link2="l1"/></robot>'
    write(folder / "arm.srdf", srdf)
    path = write(folder / "arm.urdf", f'<robot name="a">{links}</robot>')
    return RobotModel.inspect(path, "tool", default_mass=1.0)


def _corners_of_the_bar(q: Floats) -> Floats:
    """In the frame of the base (N, 8, 3), m, by trigonometry: the joints turn about z, y and y."""
    yaw, lean, tilt = q[:, :1], q[:, 1:2], q[:, 1:2] + q[:, 2:]
    x, y, z = BAR.T
    ahead = 0.3 * np.sin(lean) + (0.3 + z) * np.sin(tilt) + x * np.cos(tilt)
    up = 0.32 + 0.3 * np.cos(lean) + (0.3 + z) * np.cos(tilt) - x * np.sin(tilt)
    return np.stack(
        [ahead * np.cos(yaw) - y * np.sin(yaw), ahead * np.sin(yaw) + y * np.cos(yaw), up], axis=-1
    )


@pytest.mark.parametrize("engine", ["coal", *ENGINES])
def test_the_second_part_of_a_mesh_touches_a_post(folder: Path, engine: str) -> None:
    """60 poses in which a corner of the bar is inside the post, and 60 in which the tool is before it."""
    robot = _arm_with_a_bar(folder)
    q = uniform_q(robot, 20_000, seed=0)
    corners = _corners_of_the_bar(q)
    inside = ((corners > POST[0] + 1e-3) & (corners < POST[1] - 1e-3)).all(axis=2).any(axis=1)
    # The cube surrounds the tool's origin, 0.2 m from the centre of the bar.
    before = (corners[..., 0] < POST[0, 0] - 0.25).all(axis=1)
    assert _check(engine, robot, q[inside][:60]).sum() == 60
    assert _check(engine, robot, q[before][:60]).sum() == 0


CUBE = "".join(f"v {x} {y} {z}\n" for x in (0, 0.2) for y in (0, 0.2) for z in (0, 0.2))
QUADS = ("1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4")
POOR = {
    "open": QUADS[1:],
    "repeated": (*QUADS, *QUADS),
    "inside out": [" ".join(reversed(quad.split())) for quad in QUADS],
    "degenerate": (*QUADS, "1 1 2", "1 1 1", "1 8 8"),
    "flat": QUADS[:1],
    "one triangle": ("1 2 3",),
}
"""The faces of meshes that are not the surface of a body."""


@pytest.mark.parametrize("convex_hulls", [False, True], ids=["meshes", "hulls"])
@pytest.mark.parametrize("faces", POOR.values(), ids=POOR)
@pytest.mark.parametrize("engine", ENGINES)
def test_engines_agree_on_a_poor_mesh(
    tmp_path: Path, engine: str, faces: Sequence[str], convex_hulls: bool
) -> None:
    write(tmp_path / "poor.obj", CUBE + "".join(f"f {face}\n" for face in faces))
    mesh = '<mesh filename="poor.obj"/>'
    for other in (PRIMITIVES["box"], PRIMITIVES["sphere"], mesh):
        robot = held(tmp_path, mesh, other, convex_hulls=convex_hulls)
        coal = make_checker("coal", robot).check
        assert wrong(robot, coal, functools.partial(_check, engine, robot), 200) == {}


@pytest.mark.parametrize("engine", ["coal", "fcl"])
def test_a_hull_is_solid(folder: Path, engine: str) -> None:
    ball = trimesh.creation.icosphere(radius=0.2)
    ball.export(folder / "ball.stl")
    q = np.full((1, 6), 0.01)
    for convex_hulls in (False, True):
        robot = held(
            folder,
            '<mesh filename="ball.stl"/>',
            '<sphere radius="0.02"/>',
            convex_hulls=convex_hulls,
        )
        assert _check(engine, robot, q).tolist() == [convex_hulls]


@pytest.mark.parametrize("name", ["a#b", "a?b", "a%20b", "a b", "ä–ü", "a'b"])
@pytest.mark.parametrize("scheme", ["", "file://", "package://"])
def test_a_path_of_any_characters_works_on_every_engine(
    tmp_path: Path, name: str, scheme: str
) -> None:
    folder = tmp_path / name
    folder.mkdir()
    trimesh.creation.box((0.2, 0.2, 0.2)).export(folder / f"{name}.stl")
    place = {"": "", "file://": f"file://{folder}/", "package://": f"package://{name}/"}[scheme]
    robot = held(folder, f'<mesh filename="{place}{name}.stl"/>', '<sphere radius="0.1"/>')
    q = np.array([[0.1, 0.0, 0.0, 0.0, 0.0, 0.0]])
    for engine in ("coal", *ENGINES):
        assert _check(engine, robot, q).all()
    assert len(Scene(robot).parts[0].vertices) >= 8
