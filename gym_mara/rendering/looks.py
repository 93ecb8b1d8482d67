"""Looks: the cameras, the lights and the colours of N pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gym_mara.rendering.camera import (
    AMBIENT,
    BACKGROUND,
    FILL,
    FLOOR,
    KEY,
    TO_KEY_LIGHT,
    VIEW_ANGLE,
    Camera,
)
from gym_mara.types import Floats

Float32s = NDArray[np.float32]


class Looks(NamedTuple):
    """The camera, the light and the colours of each of N pictures."""

    eye: Float32s
    """The position of the camera (N, 3), m, in the world."""
    axes: Float32s
    """The camera's axes in the world, as columns (N, 3, 3): to the right, downwards and forwards, of length 1."""
    tangent: Float32s
    """The tangent of half the vertical angle of view (N,)."""
    to_light: Float32s
    """The unit vector towards the key light (N, 3), in the world."""
    lights: Float32s
    """The intensities of the ambient light, the key light and the fill light (N, 3)."""
    colours: Float32s
    """RGB of each part (N, P, 3), in [0, 1]."""
    ground: Float32s
    """RGB of the middle of the floor and of the background (N, 2, 3), in [0, 1]."""

    def of(self, chosen: Sequence[int]) -> Looks:
        """Some of the looks."""
        return Looks._make(values[chosen] for values in self)

    @classmethod
    def usual(cls, camera: Camera, colours: Floats) -> Looks:
        """The same camera and lights for N pictures.

        Args:
            camera: the camera.
            colours: of the parts (N, P, 3).
        """

        def all_of(value: ArrayLike) -> Float32s:
            array = np.asarray(value, np.float32)
            return np.broadcast_to(array, (len(colours), *array.shape))

        return cls(
            all_of(camera.eye),
            all_of(camera_axes(camera)),
            all_of(np.tan(np.radians(VIEW_ANGLE / 2.0))),
            all_of(TO_KEY_LIGHT),
            all_of([AMBIENT, KEY, FILL]),
            colours.astype(np.float32),
            all_of([FLOOR, BACKGROUND]),
        )


def camera_axes(camera: Camera) -> Floats:
    """The axes of a camera in the world, as columns (3, 3): to the right, downwards and forwards."""
    forwards = (camera.at - camera.eye) / np.linalg.norm(camera.at - camera.eye)
    right = np.cross(forwards, camera.up)
    right /= np.linalg.norm(right)
    return np.stack([right, -np.cross(right, forwards), forwards], axis=1)
