"""Named cameras see the whole scene."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gym_mara import rendering
from gym_mara.envs import MaraEnv
from gym_mara.envs.view import view_of
from gym_mara.rendering import CAMERAS, RenderSettings
from gym_mara.rendering.camera import VIEW_ANGLE, place_camera
from gym_mara.rendering.renderer import Renderer
from gym_mara.rendering.scene import Scene
from tests.helpers import MODULAR_ARMS, TARGET_Q

ROBOTS = {"mara": "mara", "ur5": "ur5", "modules": MODULAR_ARMS[3]}


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_arm_table_and_target_fill_the_picture_with_a_margin(robot: str, camera: str) -> None:
    env = MaraEnv(robot=ROBOTS[robot])
    env.reset()
    view, scene = view_of(env.simulation, 0), Scene(env.simulation.robot)
    for width, height in ((640, 480), (300, 600), (1200, 300)):
        placed = place_camera(scene, view, RenderSettings(width, height, camera))
        forwards = (placed.at - placed.eye) / np.linalg.norm(placed.at - placed.eye)
        right = np.cross(forwards, placed.up)
        right /= np.linalg.norm(right)
        rays = scene.points(view) - placed.eye
        ahead = np.tan(np.radians(VIEW_ANGLE / 2.0)) * (rays @ forwards)
        across = rays @ right / ahead * height / width
        upwards = rays @ np.cross(right, forwards) / ahead
        # From -1 to 1, from one side of the picture to the other.
        sides = np.array([across.min(), across.max(), upwards.min(), upwards.max()])
        assert np.abs(sides).max() < 0.95, "a margin on every side"
        assert max(sides[1] - sides[0], sides[3] - sides[2]) > 1.8, "and none too wide"
        assert np.abs(sides[::2] + sides[1::2]).max() < 0.3, "the scene is in the middle"
    env.close()


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
