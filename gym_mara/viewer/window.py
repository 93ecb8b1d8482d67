"""A window in the browser that shows an arm which another program moves."""

from __future__ import annotations

import time

import numpy as np

from gym_mara.rendering.camera import place_camera
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.settings import RenderSettings
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel
from gym_mara.types import Floats
from gym_mara.viewer.browser_scene import BrowserScene
from gym_mara.viewer.gate import Gate
from gym_mara.viewer.viewer import sender_errors_ignored, start_server

_FRAME_PERIOD = 1.0 / 25.0
"""The time between two pictures in the browser, s."""


class Window:
    """Shows an arm in the browser. Its user can turn the view, and nothing else.

    Args:
        robot: the arm.
        settings: the initial camera, and the address to listen on.

    Raises:
        GymMaraError: it cannot listen on the address.
        MissingExtraError: a library is not installed.
    """

    def __init__(self, robot: RobotModel, settings: RenderSettings | None = None) -> None:
        settings = settings or RenderSettings()
        self._server = start_server(settings, robot.name, Gate(settings.viewer_host))
        self.url = f"http://{settings.viewer_host}:{self._server.get_port()}"
        """The address to open in a browser."""
        self._tool = robot.kinematics()
        self._drawn = 0.0
        scene, view = Scene(robot), self._view(robot.home, frozenset())
        self._scene = BrowserScene(self._server, scene, place_camera(scene, view, settings), view)
        self._scene.target.visible = False  # the arm has no target

    def show(self, q: Floats, touching: frozenset[str] = frozenset()) -> None:
        """Draw the arm, unless it has just been drawn.

        Args:
            q: the joint positions (J,), rad (m).
            touching: the names of the links that collide.
        """
        now = time.monotonic()
        if now - self._drawn < _FRAME_PERIOD or not self._server.get_clients():
            return
        self._drawn = now
        with sender_errors_ignored():
            self._scene.show(self._view(q, touching))

    def _view(self, q: Floats, touching: frozenset[str]) -> View:
        position, quaternion = self._tool.pose(q[None])
        return View(np.array(q), position[0], quaternion[0], touching)

    def close(self) -> None:
        """Stop the server."""
        self._server.stop()
