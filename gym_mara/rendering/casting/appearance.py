"""Appearance: the cameras, the lights and the colours of N pictures."""

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
)
from gym_mara.types import Floats, Mask

Float32s = NDArray[np.float32]


class Appearance(NamedTuple):
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

    def of(self, chosen: Sequence[int] | NDArray[np.int64]) -> Appearance:
        """Those of some of the pictures."""
        return Appearance._make(values[chosen] for values in self)

    @classmethod
    def usual(
        cls, eye: Floats, at: Floats, up: Floats, colours: Floats, angle: float = VIEW_ANGLE
    ) -> Appearance:
        """The usual lights for N pictures.

        Args:
            eye: the positions of the cameras (N, 3), m.
            at: the points that they look at (N, 3), m.
            up: the upward directions of the pictures (N, 3).
            colours: of the parts (N, P, 3).
            angle: the vertical angle of view, deg.
        """

        def all_of(value: ArrayLike) -> Float32s:
            array = np.asarray(value, np.float32)
            return np.broadcast_to(array, (len(eye), *array.shape))

        return cls(
            eye.astype(np.float32),
            _axes(eye, at, up).astype(np.float32),
            all_of(np.tan(np.radians(angle / 2.0))),
            all_of(TO_KEY_LIGHT),
            all_of([AMBIENT, KEY, FILL]),
            colours.astype(np.float32),
            all_of([FLOOR, BACKGROUND]),
        )

    def randomised(
        self, generators: Sequence[np.random.Generator], light: float, colour: float, marker: Mask
    ) -> Appearance:
        """The same cameras with random lights and colours.

        Args:
            generators: of each picture.
            light: each intensity is multiplied by a number from 1 - light to 1 + light, and the light comes from a direction that
                differs by up to `light` along each axis.
            colour: each of the three components of a colour differs by up to this much.
            marker: the parts (P,) that keep their colours.
        """
        to_light, lights, colours, ground = (
            values.copy() for values in (self.to_light, self.lights, self.colours, self.ground)
        )
        for i, generator in enumerate(generators):
            lights[i] *= 1.0 + light * generator.uniform(-1.0, 1.0, 3)
            direction = to_light[i] + light * generator.uniform(-1.0, 1.0, 3)
            direction[2] = max(direction[2], 0.2)  # from above
            to_light[i] = direction / np.linalg.norm(direction)
            shift = colour * generator.uniform(-1.0, 1.0, colours[i].shape)
            colours[i] += np.where(marker[:, None], 0.0, shift)
            ground[i] += colour * generator.uniform(-1.0, 1.0, (2, 3))
        return self._replace(
            to_light=to_light,
            lights=lights,
            colours=np.clip(colours, 0.0, 1.0),
            ground=np.clip(ground, 0.0, 1.0),
        )


def _axes(eye: Floats, at: Floats, up: Floats) -> Floats:
    """The axes of N cameras in the world, as columns (N, 3, 3): to the right, downwards and forwards."""
    forwards = (at - eye) / np.linalg.norm(at - eye, axis=1, keepdims=True)
    right = np.cross(forwards, up)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return np.stack([right, -np.cross(right, forwards), forwards], axis=2)
