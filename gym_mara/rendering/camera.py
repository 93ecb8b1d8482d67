"""How a scene is looked at and lit, whatever draws it: the camera, the lamp, the floor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gym_mara.rendering.scene import Colour, Floats, Scene
from gym_mara.rendering.settings import CAMERAS, RenderSettings
from gym_mara.rendering.view import View

VIEW_ANGLE = 30.0
"""Between the lower and the upper edge of a picture, deg."""
AMBIENT, KEY, FILL = 0.40, 0.50, 0.18
"""How much light comes from everywhere, from the lamp, and from the camera."""
SHINE = 0.12
"""How much of the light surfaces reflect as a mirror would."""
TO_LAMP: Floats = np.array([-0.25, -0.45, 1.0]) / np.linalg.norm([-0.25, -0.45, 1.0])
"""Where the lamp is, a direction in the world frame."""
BACKGROUND: Colour = (0.94, 0.95, 0.96)
FLOOR: Colour = (0.80, 0.82, 0.84)
"""Where it is darkest, under the arm; it fades into the background."""
SHADE = 0.80
"""How bright the floor's shadow is, of the floor."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera, and the floor that it sees."""

    eye: Floats
    """Where the camera is (3,), m, in the world frame."""
    at: Floats
    """What it looks at (3,), m."""
    up: Floats
    """(3,)."""
    floor: Floats
    """The middle of the floor (3,), m."""
    floor_radius: float
    """Where it has faded away, m."""


def place_camera(scene: Scene, view: View, settings: RenderSettings) -> Camera:
    """The look of a scene: a named camera sees all that moves, as it stands in this view."""
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


def floor_colour(away: Floats) -> Floats:
    """The floor's colour (..., 3), in [0, 1], so far (...) from its middle, 1 where it has faded away."""
    faded = np.clip(away, 0.0, 1.0)[..., None] ** 0.7
    return (1.0 - faded) * np.array(FLOOR) + faded * np.array(BACKGROUND)


def shaded(colour: Colour, light: float) -> Colour:
    """A colour in so much light."""
    red, green, blue = (light * value for value in colour)
    return red, green, blue
