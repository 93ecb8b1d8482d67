"""Pictures of many arms at once, by ray casting on the CPU.

What does not move is drawn once for each camera and light, and kept (`_Background`).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.rendering.camera import Camera
from gym_mara.rendering.casting.looks import Looks
from gym_mara.rendering.casting.rays import Float32s, Hits, Indices, Int32s
from gym_mara.rendering.casting.shading import NOTHING, Photo, Seen, Surfaces, inside
from gym_mara.rendering.scene import Scene
from gym_mara.types import Floats, Mask

_EDGE_OFFSETS = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]], np.float32)
"""Offsets from a pixel's centre of the rays through a pixel at an edge, pixels."""
_EDGE_COSINE = 0.9
"""Neighbouring normals whose cosine is less than this form an edge."""


class Drawn(NamedTuple):
    """N pictures of height H and width W."""

    colour: NDArray[np.uint8]
    """RGB (N, H, W, 3)."""
    depth: Float32s
    """How far what is seen is from the camera along its axis (N, H, W), m; infinite for the background."""
    part: Int32s
    """The index of the part (N, H, W), or FLOOR_PART, or NOTHING."""


class _Background(NamedTuple):
    """What does not move in pictures of H · W pixels, for each of U looks; all arrays are (U · H · W, …)."""

    seen: Seen
    lit: Mask
    """Whether nothing fixed is between the point and the key light."""
    point: Float32s
    """What is seen, in the world, m."""
    across_light: Float32s
    """The point in the plane across the key light, m."""


class Caster:
    """Casts one ray through each pixel, four through each pixel at an edge, and from each hit one to the key light.

    Args:
        scene: the parts to draw.
        camera: it has the floor.
        width: of a picture, pixels.
        height: of a picture, pixels.
    """

    def __init__(self, scene: Scene, camera: Camera, width: int, height: int) -> None:
        self._surfaces = Surfaces(scene, camera)
        bodies = self._surfaces.bodies.all
        self._fixed = [body for body in bodies if body.number == 0]
        self._moving = [body for body in bodies if body.number > 0]
        self._fixed_parts = np.flatnonzero(scene.body_of_part == 0)
        self._width, self._height = width, height
        columns, rows = np.meshgrid(np.arange(width), np.arange(height))
        pixels = np.stack([columns.ravel(), rows.ravel()], axis=1)
        self._points = (pixels - (np.array([width, height]) - 1.0) / 2.0).astype(np.float32)
        self._known: list[bytes] = []
        self._background: _Background | None = None

    def draw(self, poses: Floats, looks: Looks) -> Drawn:
        """Draw N arms.

        Args:
            poses: of the bodies of each arm (N, B, 4, 4).
            looks: the N cameras, lights and colours.
        """
        size, shape = len(self._points), (len(poses), self._height, self._width)
        behind, row = self._behind(poses, looks)
        # Of each pixel of the N pictures, its place in the background.
        place = (row[:, None] * size + np.arange(size)).ravel()
        seen, lit = behind.seen.of(place), behind.lit[place]
        moving = Photo(self._surfaces, self._moving, poses, looks, self._height)
        photo = Photo(self._surfaces, self._fixed + self._moving, poses, looks, self._height)
        changed = np.zeros(len(place), bool)
        moved = self._add_moving(moving, seen)
        changed[moved] = True
        arm, pixel = np.divmod(moved, size)
        points = photo.rays(arm, self._points[pixel]).at(seen.depth[moved])
        lit[moved] = photo.lit(points, arm, seen.normal[moved])
        shadow = self._shadow(moving, behind, place, np.flatnonzero(lit & ~changed))
        lit[shadow], changed[shadow] = False, True
        colour = seen.colour(lit)
        edges = _edges(seen, lit, changed, shape)
        if len(edges):
            colour[edges] = self._finer(photo, *np.divmod(edges, size))
        picture = np.uint8(255.0 * np.clip(colour, 0.0, 1.0) + 0.5)
        return Drawn(
            picture.reshape(*shape, 3), seen.depth.reshape(shape), seen.part.reshape(shape)
        )

    def _behind(self, poses: Floats, looks: Looks) -> tuple[_Background, Indices]:
        """What does not move, for each different look, and which look each of the N arms has (N,)."""
        own = looks._replace(colours=looks.colours[:, self._fixed_parts])
        keys = [b"".join(values[i].tobytes() for values in own) for i in range(len(poses))]
        new = list(dict.fromkeys(key for key in keys if key not in self._known))
        if new or self._background is None:
            first = [keys.index(key) for key in new]
            drawn = self._draw_fixed(poses[first], looks.of(first))
            kept = [i for i, key in enumerate(self._known) if key in keys]
            if self._background is not None and kept:
                drawn = _joined(_rows(self._background, kept, len(self._known)), drawn)
            self._known = [*(self._known[i] for i in kept), *new]
            self._background = drawn
        return self._background, np.array([self._known.index(key) for key in keys])

    def _draw_fixed(self, poses: Floats, looks: Looks) -> _Background:
        photo = Photo(self._surfaces, self._fixed, poses, looks, self._height)
        arm = np.repeat(np.arange(len(poses)), len(self._points))
        rays, seen = photo.see(arm, np.tile(self._points, (len(poses), 1)))
        points = rays.at(np.where(seen.part == NOTHING, np.float32(0.0), seen.depth))
        lit = photo.lit(points, arm, seen.normal) | (seen.part == NOTHING)
        everywhere = np.ones(len(arm), bool)
        edges = _edges(seen, lit, everywhere, (len(poses), self._height, self._width))
        if len(edges):
            fine = self._finer(photo, *np.divmod(edges, len(self._points)))
            # Where a shadow falls on an edge later, its pixel is drawn again.
            seen.bright[edges] = seen.dark[edges] = fine
        return _Background(seen, lit, points, photo.across_light(points, arm))

    def _add_moving(self, moving: Photo, seen: Seen) -> Indices:
        """Enter the moving bodies in what is seen, and return the pixels where they are, as indices of all pictures."""
        size = len(self._points)
        chosen = [self._within(box) for box in moving.in_picture.swapaxes(0, 1)]
        near = np.zeros(len(seen.part), bool)
        for pixels in chosen:
            near[pixels] = True
        all_near = np.flatnonzero(near)
        number = np.cumsum(near) - 1
        arm, pixel = np.divmod(all_near, size)
        rays = moving.rays(arm, self._points[pixel])
        hits = Hits.none(len(all_near))
        hits.distance[:] = seen.depth[all_near]
        for body, pixels in zip(moving.bodies, chosen, strict=True):
            moving.cast(body, rays, number[pixels], hits)
        hit = np.flatnonzero(hits.face >= 0)
        new = moving.shade(rays.of(hit), hits.of(hit))
        for values, own in zip(seen, new, strict=True):
            values[all_near[hit]] = own
        return all_near[hit]

    def _within(self, box: Floats) -> Indices:
        """The pixels of all pictures, as indices, within a rectangle of each picture (N, 2, 2)."""
        size = np.array([self._width, self._height])
        box = np.clip(box + (size - 1.0) / 2.0, -1.0, size)
        low = np.clip(np.ceil(box[:, 0]), 0, size).astype(np.int64)
        extent = np.maximum(np.clip(np.floor(box[:, 1]) + 1, 0, size).astype(np.int64) - low, 0)
        count = extent.prod(axis=1)
        number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        row, column = np.divmod(number, np.repeat(extent[:, 0], count))
        corner = np.arange(len(box)) * size.prod() + low[:, 1] * self._width + low[:, 0]
        return np.repeat(corner, count) + row * self._width + column

    def _shadow(
        self, moving: Photo, behind: _Background, place: Indices, pixels: Indices
    ) -> Indices:
        """Those of the pixels, which show something fixed in the light, that are in the shadow of a moving body."""
        box = moving.in_light
        around = np.stack([box[:, :, 0].min(axis=1), box[:, :, 1].max(axis=1)], axis=1)
        arm = pixels // len(self._points)
        flat = behind.across_light[place[pixels]]
        near = inside(flat, around[arm]) & (behind.seen.part[place[pixels]] != NOTHING)
        pixels, arm = pixels[near], arm[near]
        points, normal = behind.point[place[pixels]], behind.seen.normal[place[pixels]]
        return pixels[~moving.lit(points, arm, normal)]

    def _finer(self, photo: Photo, arm: Indices, pixel: Indices) -> Float32s:
        """RGB of pixels at edges (R, 3): the means of four rays each."""
        count = len(_EDGE_OFFSETS)
        points = np.concatenate([self._points[pixel] + offset for offset in _EDGE_OFFSETS])
        rays, seen = photo.see(np.tile(arm, count), points)
        solid = np.flatnonzero(seen.part != NOTHING)
        lit = np.ones(len(points), bool)
        at = rays.of(solid)
        lit[solid] = photo.lit(at.at(seen.depth[solid]), at.arm, seen.normal[solid])
        return seen.colour(lit).reshape(count, -1, 3).mean(axis=0)


def _rows(background: _Background, kept: list[int], count: int) -> _Background:
    """The background of some of `count` looks."""

    def of(values: Any) -> Any:
        return values.reshape(count, -1, *values.shape[1:])[kept].reshape(-1, *values.shape[1:])

    lit, point, across = (of(values) for values in background[1:])
    return _Background(Seen._make(map(of, background.seen)), lit, point, across)


def _joined(one: _Background, other: _Background) -> _Background:
    """The background of all looks of two."""
    seen = Seen._make(map(np.concatenate, zip(one.seen, other.seen, strict=True)))
    return _Background(
        seen,
        np.concatenate([one.lit, other.lit]),
        np.concatenate([one.point, other.point]),
        np.concatenate([one.across_light, other.across_light]),
    )


def _edges(seen: Seen, lit: Mask, changed: Mask, shape: tuple[int, int, int]) -> Indices:
    """The pixels, as indices, that differ from a neighbour in the part, in the normal, or in being lit, where one of both has changed."""
    part, bright, new = (values.reshape(shape) for values in (seen.part, lit, changed))
    normal = seen.normal.reshape(*shape, 3)
    edges = np.zeros(shape, np.bool_)
    for one, other in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[:, :, 1:], np.s_[:, :, :-1])):
        differs = (part[one] != part[other]) | (bright[one] != bright[other])
        differs &= new[one] | new[other]
        solid = (part[one] >= 0) & (part[other] >= 0) & new[one] & ~differs
        differs[solid] = np.vecdot(normal[one][solid], normal[other][solid]) < _EDGE_COSINE
        edges[one] |= differs
        edges[other] |= differs
    return np.flatnonzero(edges)
