"""The camera, the lights and the floor of a scene, the same for every renderer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gym_mara.rendering.scene import Colour, Scene
from gym_mara.rendering.settings import CAMERAS, RenderSettings
from gym_mara.rendering.view import View
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.types import Floats

VIEW_ANGLE = 30.0
"""The vertical field of view, deg."""
AMBIENT, KEY, FILL = 0.40, 0.50, 0.18
"""Intensities of the ambient light, of the key light, and of the fill light at the camera."""
SPECULAR = 0.12
"""The specular coefficient of surfaces."""
_SAMPLES = 2000
"""The number of random configurations that show where the arm can move."""
_MARGIN = 0.08
"""Around the scene, relative to its size in the picture."""
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
    """Place the camera and the floor.

    A named camera is placed as near as it sees the whole scene in this view, and the arm wherever it moves above the floor.
    """
    points = scene.points(view)
    lowest, highest = points.min(axis=0), points.max(axis=0)
    middle, radius = 0.5 * (lowest + highest), 0.5 * float(np.linalg.norm(highest - lowest))
    floor = np.array([middle[0], middle[1], lowest[2]])
    if isinstance(settings.camera, str):
        azimuth, elevation = np.radians(CAMERAS[settings.camera])
        flat = np.cos(elevation)
        towards = np.array([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)])
        moved = _moved(scene, floor[2])
        eye = _fitted_eye(points, towards, settings)
        if not _sees(eye, moved, towards, settings):
            eye = _fitted_eye(np.concatenate([points, moved]), towards, settings)
        at = eye - towards * ((eye - middle) @ towards)
    else:
        eye, at = (np.array(point) for point in settings.camera)
    towards = (eye - at) / np.linalg.norm(eye - at)
    return Camera(eye, at, _up(towards), floor, 4.0 * radius)


def _up(towards: Floats) -> Floats:
    """The upward direction of the picture of a camera in this direction: z, or x if it looks up or down."""
    return np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.98 else np.array([1.0, 0.0, 0.0])


def _moved(scene: Scene, floor: float) -> Floats:
    """Where the arm can move above the floor, whose height is given, m: the corners of boxes around its parts (V, 3), m."""
    low, high = reachable_range(scene.robot)
    samples = np.random.default_rng(0).uniform(low, high, (_SAMPLES, len(low)))
    corners = scene.swept(samples)
    return corners[corners[:, 2] >= floor]


def _fitted_eye(points: Floats, towards: Floats, settings: RenderSettings) -> Floats:
    """The nearest position of a camera that sees all points (V, 3), m, with a margin, if it looks against `towards` (3,).

    A camera at the position (x, y, z) in its own axes sees a point (a, b, c) if a - x and x - a are at most t · (z - c), where t is
    the tangent of half the angle of view; and so for b. Of each bound, the point with the highest a + t · c is the tightest.
    """
    axes = _axes(towards)
    seen = points @ axes.T
    tangents = _tangents(settings) / (1.0 + _MARGIN)
    high = (seen[:, :2] + tangents * seen[:, 2:]).max(axis=0)
    low = (-seen[:, :2] + tangents * seen[:, 2:]).max(axis=0)
    distance = ((high + low) / (2.0 * tangents)).max()
    return np.array([*(high - low) / 2.0, distance]) @ axes


def _sees(eye: Floats, points: Floats, towards: Floats, settings: RenderSettings) -> bool:
    """Whether all points (V, 3), m, are in the picture of a camera at a position (3,) that looks against `towards` (3,)."""
    seen = (points - eye) @ _axes(towards).T
    return bool((np.abs(seen[:, :2]) <= -_tangents(settings) * seen[:, 2:]).all())


def _axes(towards: Floats) -> Floats:
    """The axes of a camera that looks against `towards` (3,): right, up and backwards (3, 3)."""
    across = np.cross(_up(towards), towards)
    across /= np.linalg.norm(across)
    return np.array([across, np.cross(towards, across), towards])


def _tangents(settings: RenderSettings) -> Floats:
    """The tangents of half the angles of view (2,), horizontal and vertical."""
    vertical = np.tan(np.radians(VIEW_ANGLE / 2.0))
    return np.array([vertical * settings.width / settings.height, vertical])


def floor_colour(distance: Floats) -> Floats:
    """The floor's colour (..., 3), in [0, 1], at a distance (...) from its middle, relative to its radius."""
    fade = np.clip(distance, 0.0, 1.0)[..., None] ** 0.7
    return (1.0 - fade) * np.array(FLOOR) + fade * np.array(BACKGROUND)


def shaded(colour: Colour, light: float) -> Colour:
    """A colour times a light intensity."""
    red, green, blue = (light * value for value in colour)
    return red, green, blue
