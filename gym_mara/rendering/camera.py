"""The camera, the lights and the floor of a scene, the same for every renderer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gym_mara.rendering.scene import Colour, Scene
from gym_mara.rendering.settings import CAMERAS, RenderSettings
from gym_mara.rendering.view import View
from gym_mara.types import Floats

VIEW_ANGLE = 30.0
"""The vertical field of view, deg."""
AMBIENT, KEY, FILL = 0.40, 0.50, 0.18
"""Intensities of the ambient light, of the key light, and of the fill light at the camera."""
SPECULAR = 0.12
"""The specular coefficient of surfaces."""
TO_KEY_LIGHT: Floats = np.array([-0.25, -0.45, 1.0]) / np.linalg.norm([-0.25, -0.45, 1.0])
"""The unit vector towards the key light, in the world frame."""
BACKGROUND: Colour = (0.94, 0.95, 0.96)
FLOOR: Colour = (0.80, 0.82, 0.84)
"""The colour at the middle of the floor, under the arm; the floor fades into the background."""
SHADOW = 0.80
"""The brightness of a shadow on the floor, relative to the floor."""


@dataclass(frozen=True, eq=False)
class Camera:
    """The pose of a camera, and the floor of its scene, in the world frame."""

    eye: Floats
    """The position of the camera (3,), m."""
    at: Floats
    """The point that it looks at (3,), m."""
    up: Floats
    """The upward direction of the picture (3,)."""
    floor: Floats
    """The middle of the floor (3,), m."""
    floor_radius: float
    """The distance from the middle at which the floor has faded into the background, m."""


def place_camera(scene: Scene, view: View, settings: RenderSettings) -> Camera:
    """Place the camera and the floor. A named camera is placed so that it sees everything that moves in this view."""
    lowest, highest = scene.bounds(view)
    middle, radius = 0.5 * (lowest + highest), 0.5 * float(np.linalg.norm(highest - lowest))
    ground, _ = scene.bounds(view, moving=False)
    floor = np.array([middle[0], middle[1], min(0.0, ground[2])])
    if isinstance(settings.camera, str):
        azimuth, elevation = np.radians(CAMERAS[settings.camera])
        flat = np.cos(elevation)
        towards = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)]
        aspect = min(1.0, settings.width / settings.height)
        distance = 1.1 * radius / (np.sin(np.radians(VIEW_ANGLE / 2.0)) * aspect)
        eye, at = middle + distance * np.array(towards), middle
    else:
        eye, at = (np.array(point) for point in settings.camera)
    forwards = (at - eye) / np.linalg.norm(at - eye)
    upright = abs(forwards[2]) < 0.98
    up = np.array([0.0, 0.0, 1.0]) if upright else np.array([1.0, 0.0, 0.0])
    return Camera(eye, at, up, floor, 6.0 * max(radius, 0.1))


def floor_colour(distance: Floats) -> Floats:
    """The floor's colour (..., 3), in [0, 1], at a distance (...) from its middle, relative to its radius."""
    fade = np.clip(distance, 0.0, 1.0)[..., None] ** 0.7
    return (1.0 - fade) * np.array(FLOOR) + fade * np.array(BACKGROUND)


def shaded(colour: Colour, light: float) -> Colour:
    """A colour times a light intensity."""
    red, green, blue = (light * value for value in colour)
    return red, green, blue
