"""Rendering: pictures and videos of an arm, drawn by VTK or by ray casting on the CPU.

Graphics libraries are imported when the first picture is drawn.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from gym_mara.errors import MissingExtraError
from gym_mara.rendering.settings import CAMERAS, RENDERERS, RenderSettings
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel

if TYPE_CHECKING:
    from gym_mara.rendering.renderer import Picture, Renderer

__all__ = ["CAMERAS", "RENDERERS", "Pictures", "RenderSettings", "make_renderer"]


def make_renderer(robot: RobotModel, settings: RenderSettings, first: View) -> Renderer:
    """Make the chosen renderer, or the first one that works on this machine.

    Args:
        robot: the arm.
        settings: the renderer, and the size and the camera of its pictures.
        first: the view that is used to place a named camera, so that everything that moves is in the picture.

    Raises:
        MissingExtraError: the chosen renderer is not installed, or no renderer works here.
        NoDisplayError: the chosen renderer cannot draw on this machine.
    """
    from gym_mara.rendering.camera import place_camera
    from gym_mara.rendering.renderer import NoDisplayError
    from gym_mara.rendering.scene import Scene

    scene = Scene(robot)
    camera = place_camera(scene, first, settings)
    for name in RENDERERS:
        if settings.renderer in (None, name):
            try:
                return _renderer_class(name)(scene, camera, settings, first)
            except (MissingExtraError, NoDisplayError):
                if settings.renderer == name:
                    raise
    raise MissingExtraError("rendering", "PyVista with OpenGL, or embreex,", "render")


def _renderer_class(name: str) -> type[Renderer]:
    if name == "vtk":
        from gym_mara.rendering.vtk import VtkRenderer

        return VtkRenderer
    from gym_mara.rendering.raycast import RaycastRenderer

    return RaycastRenderer


class Pictures:
    """Draws the arms of one simulation; it makes its renderer for the first picture.

    Args:
        robot: the arm.
        settings: the renderer, and the size and the camera of its pictures.
    """

    def __init__(self, robot: RobotModel, settings: RenderSettings) -> None:
        self._robot, self._settings = robot, settings
        self._renderer: Renderer | None = None

    def of(self, view: View) -> Picture:
        """Draw a view: uint8 (height, width, 3), RGB."""
        if self._renderer is None:
            at_home = dataclasses.replace(view, q=self._robot.home)
            self._renderer = make_renderer(self._robot, self._settings, at_home)
        return self._renderer.render(view)

    def close(self) -> None:
        """Free the renderer, if there is one. The next picture makes a new renderer."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __reduce__(self) -> tuple[Any, ...]:
        # A renderer belongs to one process and one environment, so a copy makes its own.
        return Pictures, (self._robot, self._settings)
