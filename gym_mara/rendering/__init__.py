"""Rendering: pictures and videos of an arm, drawn by VTK or by ray casting on the CPU.

Graphics libraries are imported when the first picture is drawn.
"""

from __future__ import annotations

import functools
import itertools
import sys
import weakref
from typing import TYPE_CHECKING, Any

from gym_mara.errors import MissingExtraError
from gym_mara.rendering.settings import CAMERAS, RENDERERS, PixelSettings, RenderSettings
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel

if TYPE_CHECKING:
    from gym_mara.rendering.renderer import Picture, Renderer

_KEYS = itertools.count()
"""Numbers the renderers of this process."""

__all__ = ["CAMERAS", "RENDERERS", "Pictures", "PixelSettings", "RenderSettings", "make_renderer"]


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
    """Draws the arms of one simulation, in any thread; it makes its renderer for the first picture.

    The renderer is freed by `close`, or with this object. A copy, also in a forked process, makes a renderer of its own.

    Args:
        robot: the arm.
        settings: the renderer, and the size and the camera of its pictures.
        first: the view that is used to place a named camera, whatever is drawn.
    """

    def __init__(self, robot: RobotModel, settings: RenderSettings, first: View) -> None:
        self._robot, self._settings, self._first = robot, settings, first
        self._key = next(_KEYS)
        weakref.finalize(self, _free, self._key, wait=False).atexit = False

    def of(self, view: View) -> Picture:
        """Draw a view: uint8 (height, width, 3), RGB.

        Raises:
            MissingExtraError: the chosen renderer is not installed, or no renderer works here.
            NoDisplayError: the chosen renderer cannot draw on this machine or in this process.
        """
        from gym_mara.rendering.drawing import drawing_thread

        make = functools.partial(make_renderer, self._robot, self._settings, self._first)
        return drawing_thread().draw(self._key, make, view)

    def close(self) -> None:
        """Free the renderer, if there is one. The next picture makes a new renderer."""
        _free(self._key, wait=True)

    def __reduce__(self) -> tuple[Any, ...]:
        return Pictures, (self._robot, self._settings, self._first)


def _free(key: int, *, wait: bool) -> None:
    """Free a renderer, if a picture was ever drawn; else import nothing."""
    # The garbage collector may call this in the middle of the import of that module.
    if free := getattr(sys.modules.get("gym_mara.rendering.drawing"), "free", None):
        free(key, wait=wait)
