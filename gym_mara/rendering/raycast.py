"""The renderer "raycast": ray casting on the CPU, for machines without OpenGL."""

from __future__ import annotations

import numpy as np

from gym_mara.rendering.camera import Camera
from gym_mara.rendering.casting.appearance import Appearance
from gym_mara.rendering.casting.caster import Caster
from gym_mara.rendering.renderer import Picture, Renderer
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.settings import RenderSettings
from gym_mara.rendering.view import View


class RaycastRenderer(Renderer):
    """Ray casting, one picture at a time."""

    def __init__(self, scene: Scene, camera: Camera, settings: RenderSettings, first: View) -> None:
        super().__init__(scene, camera, settings, first)
        self._caster = Caster(scene, camera, self.width, self.height)

    def render(self, view: View) -> Picture:
        camera, colours = self.camera, np.array([self.scene.colours(view)])
        appearance = Appearance.usual(camera.eye[None], camera.at[None], camera.up[None], colours)
        return self._caster.draw(self.scene.bodies(view)[None], appearance).colour[0]
