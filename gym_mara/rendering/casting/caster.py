"""Pictures of many arms at once, by ray casting on the CPU.

What does not move is drawn once for each camera and light, and kept (`_Background`).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.rendering.camera import Camera
from gym_mara.rendering.casting.appearance import Appearance
from gym_mara.rendering.casting.rays import Float32s, Hits, Indices, Int32s
from gym_mara.rendering.casting.shading import NOTHING, PlacedBodies, Seen, Surfaces
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
    """What does not move in pictures of K pixels, for each of U appearances."""

    colour: Float32s
    """RGB in [0, 1], in the shadow of fixed bodies alone (U, K, 3)."""
    dark: Float32s
    """RGB in the shadow (U, K, 3)."""
    depth: Float32s
    """As in Seen (U, K)."""
    part: Int32s
    """As in Seen (U, K)."""
    normal: Float32s
    """As in Seen (U, K, 3)."""
    lit: Mask
    """Whether it is in the light, of which a moving body can take it away (U, K)."""
    point: Float32s
    """What is seen, in the world (U, K, 3), m."""
    across_light: Float32s
    """The point in the plane across the key light (U, K, 2), m."""


class Caster:
    """Casts one ray through each pixel, four through each pixel at an edge, and from each hit one to the key light.

    Args:
        scene: the parts to draw.
        camera: it has the floor.
        width: of a picture, pixels.
        height: of a picture, pixels.
        moves: whether the camera moves with the arm; what it has seen then is not kept.
    """

    def __init__(
        self, scene: Scene, camera: Camera, width: int, height: int, *, moves: bool = False
    ) -> None:
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
        self._most, self._moves = 0, moves
        self._background: _Background | None = None

    def draw(self, poses: Floats, appearance: Appearance) -> Drawn:
        """Draw N arms.

        Args:
            poses: of the bodies of each arm (N, B, 4, 4).
            appearance: the N cameras, lights and colours.
        """
        size, shape = len(self._points), (len(poses), self._height, self._width)
        behind, row = self._behind(poses, appearance)
        colour, depth = behind.colour[row], behind.depth[row]
        part, lit = behind.part[row], behind.lit[row]
        bodies = self._surfaces.bodies.all
        moving, placed = (
            PlacedBodies(self._surfaces, chosen, poses, appearance, self._height)
            for chosen in (self._moving, bodies)
        )
        arm, pixel, new = self._see_moving(moving, depth)
        depth[arm, pixel], part[arm, pixel] = new.depth, new.part
        points = placed.rays(arm, self._points[pixel]).at(new.depth)
        bright = placed.lit(points, arm, new.normal)
        colour[arm, pixel] = new.colour(bright)
        changed = np.zeros(lit.shape, bool)
        changed[arm, pixel] = True
        shadow = self._shadow(moving, behind, row, lit & ~changed)
        fixed = row[shadow[0]], shadow[1]
        colour[shadow] = behind.dark[fixed]
        lit[arm, pixel], lit[shadow], changed[shadow] = bright, False, True
        normal = np.empty((*lit.shape, 3), np.float32)  # only those that have changed are compared
        normal[arm, pixel], normal[shadow] = new.normal, behind.normal[fixed]
        edges = _edges(part, lit, normal, changed, shape)
        if len(edges):
            colour.reshape(-1, 3)[edges] = self._finer(placed, *np.divmod(edges, size))
        picture = np.uint8(255.0 * np.clip(colour, 0.0, 1.0) + 0.5)
        return Drawn(picture.reshape(*shape, 3), depth.reshape(shape), part.reshape(shape))

    def _behind(self, poses: Floats, appearance: Appearance) -> tuple[_Background, Indices]:
        """What does not move, for each different look, and which look each of the N arms has (N,)."""
        own = appearance._replace(colours=appearance.colours[:, self._fixed_parts])
        keys = [b"".join(values[i].tobytes() for values in own) for i in range(len(poses))]
        new = list(dict.fromkeys(key for key in keys if key not in self._known))
        if new or self._background is None:
            drawn = self._draw_fixed(poses, appearance, [keys.index(key) for key in new])
            # Some of the arms may be drawn alone, and then all of them: twice as many appearances are kept.
            self._most = max(self._most, len(keys))
            used = [i for i, key in enumerate(self._known) if key in keys]
            others = [i for i, key in enumerate(self._known) if key not in keys]
            room = 0 if self._moves else max(2 * self._most - len(used) - len(new), 0)
            kept = [*others[len(others) - min(room, len(others)) :], *used]
            if self._background is not None:
                pairs = zip(self._background, drawn, strict=True)
                drawn = _Background._make(np.concatenate([one[kept], two]) for one, two in pairs)
            self._known = [*(self._known[i] for i in kept), *new]
            self._background = drawn
        return self._background, np.array([self._known.index(key) for key in keys])

    def _draw_fixed(self, poses: Floats, appearance: Appearance, arms: list[int]) -> _Background:
        """What does not move in the pictures of some arms."""
        placed = PlacedBodies(
            self._surfaces, self._fixed, poses[arms], appearance.of(arms), self._height
        )
        arm = np.repeat(np.arange(len(arms)), len(self._points))
        rays, seen = placed.see(arm, np.tile(self._points, (len(arms), 1)))
        solid = seen.part != NOTHING
        points = rays.at(np.where(solid, seen.depth, np.float32(0.0)))
        lit = placed.lit(points, arm, seen.normal) | ~solid
        colour, dark = seen.colour(lit), seen.dark
        shape = len(arms), self._height, self._width
        edges = _edges(seen.part, lit, seen.normal, np.ones(len(lit), bool), shape)
        if len(edges):
            # Where a shadow falls on an edge later, its pixel is drawn again.
            fine = self._finer(placed, *np.divmod(edges, len(self._points)))
            colour[edges] = dark[edges] = fine
        made = (colour, dark, seen.depth, seen.part, seen.normal, lit & solid, points)
        return _Background._make(
            values.reshape(len(arms), len(self._points), *values.shape[1:])
            for values in (*made, placed.across_light(points, arm))
        )

    def _see_moving(self, moving: PlacedBodies, depth: Float32s) -> tuple[Indices, Indices, Seen]:
        """The pixels where moving bodies are, each by its arm and its index in the picture, and what is seen there.

        Args:
            moving: the moving bodies.
            depth: of what does not move (N, K), m.
        """
        boxes = [self._within(box) for box in moving.in_picture.swapaxes(0, 1)]
        near = np.zeros(depth.size, bool)
        for pixels in boxes:
            near[pixels] = True
        chosen = np.flatnonzero(near)
        number = np.cumsum(near, dtype=np.int64) - 1
        arm, pixel = np.divmod(chosen, len(self._points))
        rays, hits = moving.rays(arm, self._points[pixel]), Hits.none(len(chosen))
        hits.distance[:] = depth.ravel()[chosen]
        for body, pixels in zip(moving.bodies, boxes, strict=True):
            moving.cast(body, rays, number[pixels], hits)
        hit = np.flatnonzero(hits.face >= 0)
        return arm[hit], pixel[hit], moving.shade(rays.of(hit), hits.of(hit))

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
        self, moving: PlacedBodies, behind: _Background, row: Indices, lit: Mask
    ) -> tuple[Indices, Indices]:
        """The pixels, each by its arm and its index, in the shadow of a moving body, of those that show something fixed in the light.

        Args:
            moving: the moving bodies.
            behind: what does not move.
            row: which look each arm has (N,).
            lit: the pixels that show something fixed in the light (N, K).
        """
        box = moving.in_light
        low, high = box[:, :, 0].min(axis=1)[:, None], box[:, :, 1].max(axis=1)[:, None]
        near = lit
        for axis in (0, 1):
            flat = behind.across_light[..., axis]
            flat = flat if len(flat) == 1 else flat[row]
            near = near & (flat >= low[..., axis]) & (flat <= high[..., axis])
        arm, pixel = np.nonzero(near)
        points, normal = behind.point[row[arm], pixel], behind.normal[row[arm], pixel]
        dark = ~moving.lit(points, arm, normal)
        return arm[dark], pixel[dark]

    def _finer(self, placed: PlacedBodies, arm: Indices, pixel: Indices) -> Float32s:
        """RGB of pixels at edges (R, 3): the means of four rays each."""
        count = len(_EDGE_OFFSETS)
        points = np.concatenate([self._points[pixel] + offset for offset in _EDGE_OFFSETS])
        rays, seen = placed.see(np.tile(arm, count), points)
        solid = np.flatnonzero(seen.part != NOTHING)
        lit = np.ones(len(points), bool)
        at = rays.of(solid)
        lit[solid] = placed.lit(at.at(seen.depth[solid]), at.arm, seen.normal[solid])
        return seen.colour(lit).reshape(count, -1, 3).mean(axis=0)


def _edges(
    part: Int32s, lit: Mask, normal: Float32s, changed: Mask, shape: tuple[int, int, int]
) -> Indices:
    """The pixels, as indices, that differ from a neighbour in the part, in the normal, or in being lit, where one of both has changed.

    Args:
        part: of each pixel, and so on.
        lit: whether it is in the light.
        normal: where it has changed.
        changed: whether it has changed.
        shape: of the pictures: N, H, W.
    """
    part, normal = part.reshape(shape), normal.reshape(*shape, 3)
    bright, new = lit.reshape(shape), changed.reshape(shape)
    edges = np.zeros(shape, np.bool_)
    for one, other in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[:, :, 1:], np.s_[:, :, :-1])):
        differs = (part[one] != part[other]) | (bright[one] != bright[other])
        differs &= new[one] | new[other]
        solid = new[one] & new[other] & (part[one] >= 0) & (part[other] >= 0) & ~differs
        moved = np.nonzero(solid)
        differs[moved] = np.vecdot(normal[one][moved], normal[other][moved]) < _EDGE_COSINE
        edges[one] |= differs
        edges[other] |= differs
    return np.flatnonzero(edges)
