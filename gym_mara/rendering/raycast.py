"""The renderer "raycast": ray casting on the CPU with Embree, for machines without OpenGL.

trimesh also casts rays with Embree, but does not return where in a triangle a ray hits, which smooth shading needs. Through its
interface the first hits of a picture took 200 ms with their positions, through Embree's own 18 ms.
"""

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
    SHADOW,
    SPECULAR,
    TO_KEY_LIGHT,
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

Float32s = NDArray[np.float32]
Int32s = NDArray[np.int32]

_EDGE_OFFSETS = np.array([[-0.25, -0.25], [0.25, -0.25], [-0.25, 0.25], [0.25, 0.25]], np.float32)
"""Offsets from a pixel's centre of the rays through a pixel at an edge, pixels."""
_SURFACE_OFFSET = 1e-3
"""The distance from a surface at which the rays to the key light begin, m."""
_EDGE_COSINE = 0.9
"""Neighbouring normals whose cosine is less than this form an edge."""
_UPWARDS = np.array([0.0, 0.0, 1.0], np.float32)
_FLOOR, _NOTHING = -1, -2
"""The part indices of rays that hit the floor, or nothing."""


class _Hits(NamedTuple):
    """The hits of R rays."""

    colour: Float32s
    """RGB in [0, 1] (R, 3)."""
    part: Int32s
    """The index of the part, or _FLOOR, or _NOTHING (R,)."""
    normal: Float32s
    """The surface normal, towards the camera (R, 3); zero if no part was hit."""
    lit: NDArray[np.bool_]
    """Whether the key light reaches the point (R,)."""


class _WorldMesh(NamedTuple):
    """The parts of a view as one mesh in the world frame."""

    scene: EmbreeScene
    normals: Float32s
    """The normals of all vertices (V, 3)."""
    colours: Float32s
    """The colours of the parts (P, 3)."""


class RaycastRenderer(Renderer):
    """Casts one ray through each pixel, four through each pixel at an edge, and from each hit one to the key light."""

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
        self._rays = self._directions(self._pixels)
        parts = scene.parts
        self._part_of_face = np.repeat(np.arange(len(parts)), [len(part.faces) for part in parts])
        offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
        self._faces = np.concatenate(
            [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
        ).astype(np.int32)
        # The reflection coefficients of each part.
        marker = np.array([part.marker for part in parts])
        self._ambient = np.where(marker, 0.8, AMBIENT).astype(np.float32)
        self._diffuse = np.where(marker, 0.2, 1.0).astype(np.float32)
        self._specular = np.where(marker, 0.0, SPECULAR).astype(np.float32)

    def _directions(self, pixels: Float32s) -> Float32s:
        """The directions (R, 3) of the rays through points of the picture (R, 2), given as column and row."""
        centre = np.array([self.width - 1, self.height - 1]) / 2.0
        across, down = (pixels - centre).T
        rays = np.stack([across, -down, np.ones(len(pixels))], axis=1) @ self._axes
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), np.float32)

    def render(self, view: View) -> Picture:
        world = self._world_mesh(view)
        hits = self._cast(self._rays, world)
        colour = hits.colour
        edges = self._edges(hits)
        if edges.any():
            points = self._pixels[edges]
            rays = self._directions(np.concatenate([points + offset for offset in _EDGE_OFFSETS]))
            finer = self._cast(rays, world).colour
            colour[edges] = finer.reshape(len(_EDGE_OFFSETS), -1, 3).mean(axis=0)
        picture = np.uint8(255.0 * np.clip(colour, 0.0, 1.0) + 0.5)
        return picture.reshape(self.height, self.width, 3)

    def _world_mesh(self, view: View) -> _WorldMesh:
        vertices, normals = [], []
        for part, placement in zip(self.scene.parts, self.scene.placements(view), strict=True):
            vertices.append(part.placed(placement))
            normals.append(part.normals @ placement[:3, :3].T.astype(np.float32))
        scene = EmbreeScene()
        TriangleMesh(scene, np.concatenate(vertices), self._faces)
        colours = np.array(self.scene.colours(view), np.float32)
        return _WorldMesh(scene, np.concatenate(normals), colours)

    def _cast(self, rays: Float32s, world: _WorldMesh) -> _Hits:
        """Cast rays (R, 3) from the camera, and light the points that they hit."""
        eye = self.camera.eye.astype(np.float32)
        found = world.scene.run(np.tile(eye, (len(rays), 1)), rays, query="INTERSECT", output=1)
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
        distance_from_middle = np.linalg.norm(points[:, :2] - self.camera.floor[:2], axis=1)
        hits.lit[on_floor] = self._is_lit(points, _UPWARDS, world)
        floor = floor_colour(distance_from_middle / self.camera.floor_radius)
        hits.colour[on_floor] = floor * np.where(hits.lit[on_floor], 1.0, SHADOW)[:, None]
        on_part = np.flatnonzero(part >= 0)
        points = eye + distance[on_part, None] * rays[on_part]
        barycentric = found["u"][on_part, None], found["v"][on_part, None]
        self._shade(hits, on_part, points, rays[on_part], barycentric, face[on_part], world)
        return hits

    def _shade(
        self,
        hits: _Hits,
        on_part: NDArray[np.int64],
        points: Float32s,
        rays: Float32s,
        barycentric: tuple[Float32s, Float32s],
        faces: Int32s,
        world: _WorldMesh,
    ) -> None:
        """Set the colour, normal and light of K rays that hit a part (Blinn-Phong reflection).

        Args:
            hits: the hits of all rays.
            on_part: the indices of the K rays.
            points: the points that they hit (K, 3), m.
            rays: their directions (K, 3).
            barycentric: the coordinates u and v of the points in their faces, each (K, 1).
            faces: the indices of the faces (K,).
            world: the mesh.
        """
        first, second, third = (world.normals[self._faces[faces, corner]] for corner in range(3))
        u, v = barycentric
        normal = (1.0 - u - v) * first + u * second + v * third
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        towards_eye = -np.vecdot(normal, rays)
        normal *= np.where(towards_eye < 0.0, -1.0, 1.0)[:, None].astype(np.float32)
        part = hits.part[on_part]
        to_light = TO_KEY_LIGHT.astype(np.float32)
        lit = self._is_lit(points, normal, world)
        key = np.maximum(normal @ to_light, 0.0) * lit
        light = KEY * key + FILL * np.abs(towards_eye)
        half_vector = to_light - rays
        half_vector /= np.linalg.norm(half_vector, axis=1, keepdims=True)
        specular = np.maximum(np.vecdot(normal, half_vector), 0.0) ** 60 * lit
        matt = world.colours[part] * (self._ambient[part] + self._diffuse[part] * light)[:, None]
        hits.colour[on_part] = matt + (KEY * self._specular[part] * specular)[:, None]
        hits.normal[on_part], hits.lit[on_part] = normal, lit

    def _is_lit(self, points: Float32s, normal: Float32s, world: _WorldMesh) -> NDArray[np.bool_]:
        """Whether the key light reaches points (K, 3) of surfaces with these normals, (K, 3) or (3,)."""
        begin = np.asarray(points + _SURFACE_OFFSET * normal, np.float32)
        to_light = np.tile(TO_KEY_LIGHT.astype(np.float32), (len(points), 1))
        blocked = world.scene.run(begin, to_light, query="OCCLUDED")
        return np.asarray(blocked < 0)

    def _edges(self, hits: _Hits) -> NDArray[np.bool_]:
        """The pixels (R,) that differ from a neighbour in the part, in the normal, or in being lit."""
        shape = (self.height, self.width)
        part, lit = hits.part.reshape(shape), hits.lit.reshape(shape)
        normal = hits.normal.reshape(*shape, 3)
        edges = np.zeros(shape, np.bool_)
        for one, other in ((np.s_[1:, :], np.s_[:-1, :]), (np.s_[:, 1:], np.s_[:, :-1])):
            bent = (part[one] >= 0) & (np.vecdot(normal[one], normal[other]) < _EDGE_COSINE)
            differs = (part[one] != part[other]) | (lit[one] != lit[other]) | bent
            edges[one] |= differs
            edges[other] |= differs
        return edges.ravel()
