"""What rays from the cameras of many arms see: the nearest body or the floor, its colour, and whether the key light reaches it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gym_mara.rendering.camera import SHADOW, SPECULAR, Camera
from gym_mara.rendering.casting.appearance import Appearance
from gym_mara.rendering.casting.rays import (
    Bodies,
    Body,
    Float32s,
    Hits,
    Indices,
    Int32s,
    Rays,
    blocked,
    boxes,
    cast,
    turned,
)
from gym_mara.rendering.scene import Scene
from gym_mara.types import Floats, Mask

_SURFACE_OFFSET = np.float32(1e-3)
"""The distance from a surface at which the rays to the key light begin, m."""
_NEAR = 1e-3
"""The distance in front of the camera from which corners of boxes have a place in the picture, m."""
FLOOR_PART, NOTHING = -1, -2
"""The part indices of rays that hit the floor, or nothing."""


class Seen(NamedTuple):
    """What R rays see."""

    bright: Float32s
    """RGB in [0, 1] with the key light (R, 3)."""
    dark: Float32s
    """RGB in the shadow (R, 3)."""
    depth: Float32s
    """How far it is from the camera along its axis (R,), m; infinite for the background."""
    part: Int32s
    """The index of the part (R,), or FLOOR_PART, or NOTHING."""
    normal: Float32s
    """The surface normal, towards the camera (R, 3); zero for the background."""

    def of(self, chosen: Indices) -> Seen:
        """Some of what is seen."""
        return Seen._make(values[chosen] for values in self)

    def colour(self, lit: Mask) -> Float32s:
        """RGB in [0, 1] (R, 3), where the key light reaches some of the points (R,)."""
        return np.where(lit[:, None], self.bright, self.dark)


class Surfaces:
    """The bodies of a scene, the floor, and how parts reflect light.

    Args:
        scene: the parts.
        camera: it has the floor.
    """

    def __init__(self, scene: Scene, camera: Camera) -> None:
        self.bodies = Bodies(scene)
        self.floor = camera.floor.astype(np.float32)
        self.floor_radius = camera.floor_radius
        self.marker = np.array([part.marker for part in scene.parts])
        self.diffuse = np.where(self.marker, 0.2, 1.0).astype(np.float32)
        self.specular = np.where(self.marker, 0.0, SPECULAR).astype(np.float32)


class PlacedBodies:
    """N arms, or some of their bodies, each with its camera, its lights and its colours.

    Args:
        surfaces: of the scene.
        bodies: those that are in the pictures.
        poses: of all bodies of each arm (N, B, 4, 4).
        appearance: the cameras, lights and colours.
        height: of a picture, pixels.
    """

    def __init__(
        self,
        surfaces: Surfaces,
        bodies: Sequence[Body],
        poses: Floats,
        appearance: Appearance,
        height: int,
    ) -> None:
        self._surfaces, self.bodies, self._poses = surfaces, bodies, poses
        self._appearance = appearance
        corners = boxes(bodies, poses)
        scale = np.float32(height / 2.0) / appearance.tangent
        self._scale: Float32s = scale
        local = np.matmul(corners - appearance.eye[:, None, None], appearance.axes[:, None])
        flat = scale[:, None, None, None] * local[..., :2] / np.maximum(local[..., 2:], _NEAR)
        ends = np.stack([flat.min(axis=2), flat.max(axis=2)], axis=2)
        self.in_picture: Float32s = ends.astype(np.float32)
        """The lowest and highest corner of the rectangle around each body in the pictures (N, bodies, 2, 2), pixels from the middle."""
        # A box that begins behind the camera may be anywhere in the picture.
        behind = (local[..., 2] < _NEAR).any(axis=2)
        self.in_picture[behind] = [[-np.inf, -np.inf], [np.inf, np.inf]]
        away = np.eye(3)[np.abs(appearance.to_light).argmin(axis=1)]
        across = np.cross(appearance.to_light, away)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        plane = np.stack([across, np.cross(appearance.to_light, across)], axis=2)
        self._plane = plane.astype(np.float32)
        flat = np.matmul(corners, plane[:, None])
        in_light = np.stack([flat.min(axis=2), flat.max(axis=2)], axis=2)
        self.in_light: Float32s = in_light.astype(np.float32)
        """The same in the plane across the key light (N, bodies, 2, 2), m."""

    def rays(self, arm: Indices, points: Float32s) -> Rays:
        """The rays through points of the pictures (R, 2), pixels from the middle; they advance by 1 m along the camera's axis."""
        ahead = np.ones((len(points), 3), np.float32)
        ahead[:, :2] = points / self._scale[arm, None]
        return Rays(arm, self._appearance.eye[arm], turned(self._appearance.axes[arm], ahead))

    def cast(self, body: Body, rays: Rays, chosen: Indices, hits: Hits) -> None:
        """Cast some rays at a body, as `gym_mara.rendering.casting.rays.cast`."""
        cast(body, self._poses, rays, chosen, hits)

    def see(self, arm: Indices, points: Float32s) -> tuple[Rays, Seen]:
        """What rays through points of the pictures (R, 2) see."""
        rays, hits = self.rays(arm, points), Hits.none(len(arm))
        for body, box in zip(self.bodies, self.in_picture.swapaxes(0, 1), strict=True):
            self.cast(body, rays, np.flatnonzero(inside(points, box[arm])), hits)
        return rays, self.shade(rays, hits)

    def shade(self, rays: Rays, hits: Hits) -> Seen:
        """The colours of what rays have hit, or else of the floor and the background."""
        arm, floor_at = rays.arm, self._surfaces.floor
        middle, background = self._appearance.ground[arm, 0], self._appearance.ground[arm, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            to_floor = (floor_at[2] - rays.origin[:, 2]) / rays.direction[:, 2]
        part = np.where(hits.face >= 0, self._surfaces.bodies.part_of_face[hits.face], NOTHING)
        part[(to_floor > 0.0) & (to_floor < hits.distance)] = FLOOR_PART
        floor, body = np.flatnonzero(part == FLOOR_PART), np.flatnonzero(part >= 0)
        depth = hits.distance.copy()
        depth[floor] = to_floor[floor]
        normal = np.zeros_like(rays.origin)
        normal[floor, 2] = 1.0
        bright, dark = background, background.copy()
        away = rays.of(floor).at(depth[floor])[:, :2] - floor_at[:2]
        distance = np.linalg.norm(away, axis=1) / self._surfaces.floor_radius
        fade = np.clip(distance, 0.0, 1.0)[:, None] ** np.float32(0.7)
        bright[floor] = (1.0 - fade) * middle[floor] + fade * background[floor]
        dark[floor] = SHADOW * bright[floor]
        reflected = self._reflect(rays.of(body), part[body], hits.of(body))
        bright[body], dark[body], normal[body] = reflected
        return Seen(bright, dark, depth, part, normal)

    def _reflect(self, rays: Rays, part: Int32s, hits: Hits) -> tuple[Float32s, Float32s, Float32s]:
        """RGB with and without the key light (Blinn-Phong reflection), and the normals, each (R, 3), of parts (R,) that rays have hit."""
        appearance, surfaces, arm = self._appearance, self._surfaces, rays.arm
        normal = surfaces.bodies.normals(hits, arm, self._poses)
        ahead = rays.direction / np.linalg.norm(rays.direction, axis=1, keepdims=True)
        towards_eye = -np.vecdot(normal, ahead)
        normal = np.where(towards_eye[:, None] < 0.0, -normal, normal)
        ambient, key, fill = appearance.lights[arm].T
        ambient = np.where(surfaces.marker[part], np.float32(0.8), ambient)
        colour, diffuse = appearance.colours[arm, part], surfaces.diffuse[part]
        dark = colour * (ambient + diffuse * fill * np.abs(towards_eye))[:, None]
        to_light = appearance.to_light[arm]
        facing = np.maximum(np.vecdot(normal, to_light), 0.0)
        half = to_light - ahead
        half /= np.linalg.norm(half, axis=1, keepdims=True)
        glossy = surfaces.specular[part] * np.maximum(np.vecdot(normal, half), 0.0) ** 60
        bright = dark + colour * (diffuse * key * facing)[:, None] + (key * glossy)[:, None]
        return bright, dark, normal

    def lit(self, points: Float32s, arm: Indices, normal: Float32s) -> Mask:
        """Whether no body is between the key light and points (R, 3) of surfaces with these normals (R, 3)."""
        lit = np.ones(len(arm), bool)
        if not lit.size:
            return lit
        begin, to_light = points + _SURFACE_OFFSET * normal, self._appearance.to_light[arm]
        flat = self.across_light(points, arm)
        for body, box in zip(self.bodies, self.in_light.swapaxes(0, 1), strict=True):
            chosen = np.flatnonzero(lit & inside(flat, box[arm]))
            if len(chosen):
                rays = Rays(arm[chosen], begin[chosen], to_light[chosen])
                lit[chosen] = ~blocked(body, self._poses, rays)
        return lit

    def across_light(self, points: Float32s, arm: Indices) -> Float32s:
        """Points (R, 3) in the plane across the key light (R, 2), m."""
        return np.asarray(np.einsum("rij,ri->rj", self._plane[arm], points), np.float32)


def inside(points: Float32s, box: Floats) -> Mask:
    """Whether points (R, 2) are within rectangles (R, 2, 2), each the lowest and the highest corner."""
    low, high = box[:, 0], box[:, 1]
    across = (points[:, 0] >= low[:, 0]) & (points[:, 0] <= high[:, 0])
    return across & (points[:, 1] >= low[:, 1]) & (points[:, 1] <= high[:, 1])
