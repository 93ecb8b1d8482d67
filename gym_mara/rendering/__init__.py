"""Rendering: pictures of an arm by VTK or by casting rays, films of it, and a viewer in the browser.

Nothing that draws is imported before it is first needed.
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
    """The renderer that was chosen, or else the first that works on this machine.

    Args:
        robot: the arm.
        settings: which renderer, and the size and the camera of its pictures.
        first: the view that a named camera is placed by: it sees all that moves, as it stands there.

    Raises:
        MissingExtraError: the renderer, or every renderer, is not installed.
        NoDisplayError: the renderer that was chosen cannot draw on this machine.
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
    """Pictures of the arms of one simulation; the renderer is made when the first is asked for.

    Args:
        robot: the arm.
        settings: the renderer, the size, the camera.
    """

    def __init__(self, robot: RobotModel, settings: RenderSettings) -> None:
        self._robot, self._settings = robot, settings
        self._renderer: Renderer | None = None

    def of(self, view: View) -> Picture:
        """The picture of a view: uint8 (height, width, 3), RGB."""
        if self._renderer is None:
            at_home = dataclasses.replace(view, q=self._robot.home)
            self._renderer = make_renderer(self._robot, self._settings, at_home)
        return self._renderer.render(view)

    def close(self) -> None:
        """Free the renderer, if there is one; the next picture makes a new one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None

    def __reduce__(self) -> tuple[Any, ...]:
        # A renderer belongs to its process, and to one environment: a copy makes its own.
        return Pictures, (self._robot, self._settings)
