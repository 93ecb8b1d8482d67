"""Named cameras see the whole scene, wherever the arm moves; markers are in proportion to the arm."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from gym_mara import rendering
from gym_mara.envs import MaraEnv
from gym_mara.envs.view import view_of
from gym_mara.rendering import CAMERAS, RenderSettings
from gym_mara.rendering.camera import VIEW_ANGLE, Camera, place_camera
from gym_mara.rendering.renderer import Renderer
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel
from gym_mara.testing import uniform_q
from gym_mara.types import Floats
from tests.helpers import MODULAR_ARMS, TARGET_Q, write
from tests.robot import arms

SIZES = ((640, 480), (300, 600), (1200, 300))


def _arm(length: float, base: float) -> str:
    """The URDF of an arm of this length, m, of three links and one that follows, on a base of this height."""
    part = length / 3.0
    link = '<link name="{}"><collision><origin xyz="0 0 {}"/><geometry><box size="{}"/></geometry></collision></link>'
    boxes = [link.format("base", -base / 2.0, f"{part} {part} {base}")]
    boxes += [
        link.format(f"link{n}", part / 2.0, f"{part / 4} {part / 4} {0.9 * part}") for n in range(4)
    ]
    joint = """<joint name="joint{0}" type="revolute"><parent link="{1}"/><child link="link{0}"/><origin xyz="{2}"/>
      <axis xyz="{3}"/><limit lower="-2" upper="2" effort="50" velocity="2"/>{4}</joint>"""
    joints = [joint.format(0, "base", "0 0 0", "0 0 1", "")]
    joints += [joint.format(n, f"link{n - 1}", f"0 0 {part}", "0 1 0", "") for n in (1, 2)]
    mimic = '<mimic joint="joint2" multiplier="-1"/>'
    joints += [joint.format(3, "link1", f"0 {part} {part}", "0 1 0", mimic)]
    return f'<robot name="arm">{"".join(boxes + joints)}</robot>'


def _scene(robot: Any, **options: Any) -> tuple[Scene, View]:
    """The scene of a robot, and the view of its first observation."""
    env = MaraEnv(robot=robot, **options)
    env.reset(seed=0)
    try:
        return Scene(env.simulation.robot), view_of(env.simulation, 0)
    finally:
        env.close()


def _in_picture(points: Floats, placed: Camera, width: int, height: int) -> Floats:
    """Where points are in a picture (V, 2): from -1 to 1, from the left to the right and from the bottom to the top."""
    forwards = (placed.at - placed.eye) / np.linalg.norm(placed.at - placed.eye)
    right = np.cross(forwards, placed.up)
    right /= np.linalg.norm(right)
    rays = points - placed.eye
    ahead = np.tan(np.radians(VIEW_ANGLE / 2.0)) * (rays @ forwards)
    upwards = rays @ np.cross(right, forwards) / ahead
    return np.stack([rays @ right / ahead * height / width, upwards], axis=-1)


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("robot", ["mara", "ur5", MODULAR_ARMS[3]], ids=["mara", "ur5", "modules"])
def test_arm_table_and_target_are_in_the_picture_with_a_margin(robot: Any, camera: str) -> None:
    scene, view = _scene(robot)
    for width, height in SIZES:
        placed = place_camera(scene, view, RenderSettings(width, height, camera))
        assert np.abs(_in_picture(scene.points(view), placed, width, height)).max() < 0.95


def test_the_camera_of_an_environment_sees_the_home_pose_whatever_it_draws_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    views: list[Any] = []
    make = rendering.make_renderer

    def noted(robot: Any, settings: Any, first: Any) -> Renderer:
        views.append(first)
        return make(robot, settings, first)

    monkeypatch.setattr(rendering, "make_renderer", noted)
    env = MaraEnv(render_mode="rgb_array", renderer="raycast", width=32, height=24)
    env.reset()
    env.step(np.array(TARGET_Q, np.float32))
    env.render()
    env.close()
    [placed_for] = views
    np.testing.assert_array_equal(placed_for.q, env.simulation.robot.home)


def test_the_target_that_is_drawn_first_does_not_move_the_camera() -> None:
    envs = [
        MaraEnv("MARAReach-v0", render_mode="rgb_array", renderer="raycast", width=32, height=24)
        for _ in range(2)
    ]
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
        env.render()  # makes the renderer
        env.reset(seed=2)
    one, other = (env.render() for env in envs)
    np.testing.assert_array_equal(one, other)
    for env in envs:
        env.close()


def test_mara_fills_the_picture() -> None:
    scene, view = _scene("mara")
    seen = _in_picture(scene.points(view), place_camera(scene, view, RenderSettings()), 640, 480)
    assert np.ptp(seen, axis=0).max() > 1.8
    middle = 0.5 * (seen.min(axis=0) + seen.max(axis=0))
    assert np.abs(middle).max() < 0.15, "the scene is in the middle"


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize(("length", "base"), [(0.2, 0.01), (3.0, 4.0)])
def test_the_whole_arm_and_its_base_are_in_every_picture(
    tmp_path: Path, length: float, base: float, camera: str
) -> None:
    scene, view = _scene(str(write(tmp_path / "arm.urdf", _arm(length, base))), ee_frame="link2")
    placed = place_camera(scene, view, RenderSettings(camera=camera))
    floor = scene.points(view)[:, 2].min()
    count = 0
    for q in (view.q, *uniform_q(scene.robot, 60, 5)):
        pairs = zip(scene.parts, scene.placements(dataclasses.replace(view, q=q)), strict=True)
        bodies = np.concatenate([part.placed(pose) for part, pose in pairs if not part.marker])
        if bodies[:, 2].min() >= floor:
            count += 1
            assert np.abs(_in_picture(bodies, placed, 640, 480)).max() <= 1.0
    assert count > 20


def test_the_arm_is_looked_for_where_joints_that_mimic_others_follow(tmp_path: Path) -> None:
    robot = RobotModel.load(arms.arm_file(tmp_path, arms.arm(more=arms.FOLLOWER)), arms.TOOL)
    scene, data = Scene(robot), robot.model.createData()
    for q in uniform_q(robot, 5, 0):
        corners = scene.swept(q[None])
        pin.forwardKinematics(robot.model, data, q)
        expected = [  # the arm's shapes are boxes along the axes of their bodies
            data.oMi[placed.parentJoint].act(placed.placement.act(np.array(corner)))
            for placed in robot.geometry.geometryObjects
            if placed.parentJoint
            for corner in itertools.product((-0.03, 0.03), (-0.03, 0.03), (-0.11, 0.11))
        ]
        assert len(corners) == len(expected) == 4 * 8
        apart = np.linalg.norm(corners[:, None] - np.array(expected), axis=-1)
        assert apart.min(axis=0).max() < 1e-6


def test_markers_are_in_proportion_to_the_arm(tmp_path: Path) -> None:
    lengths = {}
    for length in (0.2, 3.0):
        path = write(tmp_path / f"arm{length}.urdf", _arm(length, length))
        lengths[length] = _marker(_scene(str(path), ee_frame="link2")[0])
    assert lengths[3.0] / lengths[0.2] == pytest.approx(15.0, rel=0.1)
    assert _marker(_scene("mara")[0]) == pytest.approx(0.14, abs=1e-6)


def _marker(scene: Scene) -> float:
    """The length of the target's axes, m."""
    return max(float(np.abs(p.vertices).max()) for p in scene.parts if p.link == "target")
