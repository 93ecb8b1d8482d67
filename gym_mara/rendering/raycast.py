"""Pictures by casting rays on the CPU, with Embree: where there is no OpenGL."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.extras import needs
from gym_mara.rendering.camera import (
    AMBIENT,
    BACKGROUND,
    FILL,
    KEY,
    SHADE,
    SHINE,
    TO_LAMP,
    VIEW_ANGLE,
    Camera,
    floor_colour,
)
from gym_mara.rendering.renderer import Picture, Renderer
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.settings import RenderSettings
from gym_mara.rendering.view import View

with needs("the renderer 'raycast'", "render", "embreex"):
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

Singles = NDArray[np.float32]
Whole = NDArray[np.int32]

_EDGE_RAYS = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]], np.float32)
"""The rays through a pixel at the edge of something, off its middle, pixels."""
_OFF_SURFACE = 1e-3
"""How far above a surface the rays to the lamp begin, m."""
_SHARP = 0.9
"""The cosine of the angle from which on a bend counts as an edge."""
_UPWARDS = np.array([0.0, 0.0, 1.0], np.float32)
_FLOOR, _NOTHING = -1, -2
"""What a ray hits that hits no part."""


class _Hits(NamedTuple):
    """What R rays hit."""

    colour: Singles
    """(R, 3), in [0, 1]."""
    part: Whole
    """(R,): the number of the part, or _FLOOR or _NOTHING."""
    normal: Singles
    """(R, 3)."""
    lit: NDArray[np.bool_]
    """(R,): whether the lamp shines on it."""


class _Placed(NamedTuple):
    """All parts in the world frame, ready to be hit."""

    scene: EmbreeScene
    normals: Singles
    """(V, 3)."""
    colours: Singles
    """(P, 3)."""


class RaycastRenderer(Renderer):
    """A ray through each pixel, and four through those at edges; one from there to the lamp."""

    def __init__(self, scene: Scene, camera: Camera, settings: RenderSettings, first: View) -> None:
        super().__init__(scene, camera, settings, first)
        forwards = camera.at - camera.eye
        forwards /= np.linalg.norm(forwards)
        right = np.cross(forwards, camera.up)
        right /= np.linalg.norm(right)
        size = np.tan(np.radians(VIEW_ANGLE / 2.0)) / (self.height / 2.0)
        self._axes = np.array([size * right, size * np.cross(right, forwards), forwards])
        columns, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        self._pixels = np.stack([columns.ravel(), rows.ravel()], axis=1).astype(np.float32)
        self._rays = self._through(self._pixels)
        parts = scene.parts
        self._part_of_face = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
        offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
        self._faces = np.concatenate(
            [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
        ).astype(np.int32)
        # What light does for a part: how much shows by itself, and how much of the light it returns.
        marker = np.array([part.marker for part in parts])
        self._glow = np.where(marker, 0.8, AMBIENT).astype(np.float32)
        self._return = np.where(marker, 0.2, 1.0).astype(np.float32)
        self._shine = np.where(marker, 0.0, SHINE).astype(np.float32)

    def _through(self, pixels: Singles) -> Singles:
        """The directions (R, 3) of the rays through points of the picture (R, 2), column and row."""
        middle = np.array([self.width - 1, self.height - 1]) / 2.0
        across, down = (pixels - middle).T
        rays = np.stack([across, -down, np.ones(len(pixels))], axis=1) @ self._axes
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), np.float32)

    def render(self, view: View) -> Picture:
        placed = self._place(view)
        hits = self._cast(self._rays, placed)
        colour = hits.colour
        edges = self._edges(hits)
        if edges.any():
            points = self._pixels[edges]
            rays = self._through(np.concatenate([points + offset for offset in _EDGE_RAYS]))
            finer = self._cast(rays, placed).colour
            colour[edges] = finer.reshape(len(_EDGE_RAYS), -1, 3).mean(axis=0)
        picture = np.uint8(255.0 * np.clip(colour, 0.0, 1.0) + 0.5)
        return picture.reshape(self.height, self.width, 3)

    def _place(self, view: View) -> _Placed:
        vertices, normals = [], []
        for part, placement in zip(self.scene.parts, self.scene.placements(view), strict=True):
            vertices.append(part.placed(placement))
            normals.append(part.normals @ placement[:3, :3].T.astype(np.float32))
        scene = EmbreeScene()
        TriangleMesh(scene, np.concatenate(vertices), self._faces)
        colours = np.array(self.scene.colours(view), np.float32)
        return _Placed(scene, np.concatenate(normals), colours)

    def _cast(self, rays: Singles, placed: _Placed) -> _Hits:
        """What rays (R, 3) from the eye hit, in the light that falls there."""
        eye = self.camera.eye.astype(np.float32)
        found = placed.scene.run(np.tile(eye, (len(rays), 1)), rays, query="INTERSECT", output=1)
        face, distance = found["primID"], found["tfar"]
        part = np.where(face >= 0, self._part_of_face[face], _NOTHING).astype(np.int32)
        with np.errstate(divide="ignore"):
            to_floor = (self.camera.floor[2] - eye[2]) / rays[:, 2]
        part[(to_floor > 0.0) & (to_floor < distance)] = _FLOOR
        hits = _Hits(
            colour=np.tile(np.array(BACKGROUND, np.float32), (len(rays), 1)),
            part=part,
            normal=np.zeros_like(rays),
            lit=np.ones(len(rays), np.bool_),
        )
        on_floor = np.flatnonzero(part == _FLOOR)
        points = eye + to_floor[on_floor, None] * rays[on_floor]
        away = (
            np.linalg.norm(points[:, :2] - self.camera.floor[:2], axis=1) / self.camera.floor_radius
        )
        hits.lit[on_floor] = self._is_lit(points, _UPWARDS, placed)
        shade = np.where(hits.lit[on_floor], 1.0, SHADE)
        hits.colour[on_floor] = floor_colour(away) * shade[:, None]
        on_part = np.flatnonzero(part >= 0)
        points = eye + distance[on_part, None] * rays[on_part]
        weights = found["u"][on_part, None], found["v"][on_part, None]
        self._shade(hits, on_part, points, rays[on_part], weights, face[on_part], placed)
        return hits

    def _shade(
        self,
        hits: _Hits,
        at: NDArray[np.int64],
        points: Singles,
        rays: Singles,
        weights: tuple[Singles, Singles],
        faces: Whole,
        placed: _Placed,
    ) -> None:
        """Enter the colours of the rays numbered `at`, which hit faces at points (K, 3)."""
        first, second, third = (placed.normals[self._faces[faces, corner]] for corner in range(3))
        u, v = weights
        normal = (1.0 - u - v) * first + u * second + v * third
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        towards_eye = -np.vecdot(normal, rays)
        normal *= np.where(towards_eye < 0.0, -1.0, 1.0)[:, None].astype(np.float32)
        part = hits.part[at]
        lamp = TO_LAMP.astype(np.float32)
        lit = self._is_lit(points, normal, placed)
        falls = np.maximum(normal @ lamp, 0.0) * lit
        light = KEY * falls + FILL * np.abs(towards_eye)
        middle = lamp - rays  # between the lamp and the eye
        middle /= np.linalg.norm(middle, axis=1, keepdims=True)
        mirrored = np.maximum(np.vecdot(normal, middle), 0.0) ** 60 * lit
        own = placed.colours[part] * (self._glow[part] + self._return[part] * light)[:, None]
        hits.colour[at] = own + (KEY * self._shine[part] * mirrored)[:, None]
        hits.normal[at], hits.lit[at] = normal, lit

    def _is_lit(self, points: Singles, normal: Singles, placed: _Placed) -> NDArray[np.bool_]:
        """Whether the lamp shines on points (K, 3) of surfaces that face along normals."""
        begin = np.asarray(points + _OFF_SURFACE * normal, np.float32)
        to_lamp = np.tile(TO_LAMP.astype(np.float32), (len(points), 1))
        blocked = placed.scene.run(begin, to_lamp, query="OCCLUDED")
        return np.asarray(blocked < 0)

    def _edges(self, hits: _Hits) -> NDArray[np.bool_]:
        """Where (R,) something else is hit than beside it: another part, a bent surface, a shadow."""
        shape = (self.height, self.width)
        part, lit = hits.part.reshape(shape), hits.lit.reshape(shape)
        normal = hits.normal.reshape(*shape, 3)
        edges = np.zeros(shape, np.bool_)
        for one, other in ((np.s_[1:, :], np.s_[:-1, :]), (np.s_[:, 1:], np.s_[:, :-1])):
            bent = (part[one] >= 0) & (np.vecdot(normal[one], normal[other]) < _SHARP)
            differs = (part[one] != part[other]) | (lit[one] != lit[other]) | bent
            edges[one] |= differs
            edges[other] |= differs
        return edges.ravel()
