"""The contract of a renderer: it draws the views of one scene."""

from __future__ import annotations

from abc import ABC, abstractmethod

import numpy as np
from numpy.typing import NDArray

from gym_mara.errors import GymMaraError
from gym_mara.rendering.camera import Camera
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.settings import RenderSettings
from gym_mara.rendering.view import View

Picture = NDArray[np.uint8]
"""(height, width, 3), RGB."""


class NoDisplayError(GymMaraError):
    """A renderer is installed, but it finds no way to draw on this machine."""


class Renderer(ABC):
    """Draws the views of one scene from one camera.

    Args:
        scene: the parts to draw.
        camera: the camera.
        settings: the size of the pictures.
        first: a view that shows where the fixed parts are.

    Raises:
        NoDisplayError: the renderer cannot draw on this machine.
    """

    def __init__(self, scene: Scene, camera: Camera, settings: RenderSettings, first: View) -> None:
        self.scene = scene
        self.camera = camera
        self.width, self.height = settings.width, settings.height

    @abstractmethod
    def render(self, view: View) -> Picture:
        """Draw a view; the picture is a fresh array."""

    def close(self) -> None:  # noqa: B027 - some renderers have nothing to free
        """Free the renderer's resources. No other method is called afterwards."""

    @classmethod  # noqa: B027
    def close_idle(cls) -> None:
        """Free what closed renderers of this class have left for the next one."""
