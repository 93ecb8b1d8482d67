"""Casts rays at the rigid bodies of many arms at once, with Embree.

The mesh of a body never changes, so Embree gets each once, in the body's own frame. Rays are moved into that frame, and nothing is
built again when an arm moves. Of all rays only those are cast at a body that pass the box around it.

trimesh also casts rays with Embree, but does not return where in a triangle a ray hits, which smooth shading needs.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.extras import needs
from gym_mara.rendering.scene import Scene
from gym_mara.types import Floats, Mask

with needs("the renderer 'raycast'", "render", "embreex"):
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

if hasattr(os, "sched_setaffinity"):
    # Embree's scheduler, TBB, gets as many threads as the main thread may use processors when the first scene is made. It gets none
    # of its own here: a fork while one works would copy the lock that it holds, and the first picture of the new process would never end.
    _main, _processors = os.getpid(), os.sched_getaffinity(os.getpid())
    os.sched_setaffinity(_main, {min(_processors)})
    EmbreeScene()
    os.sched_setaffinity(_main, _processors)

Float32s = NDArray[np.float32]
Int32s = NDArray[np.int32]
Indices = NDArray[np.int64]


class Rays(NamedTuple):
    """R rays in the scenes of N arms."""

    arm: Indices
    """The arm of each ray (R,)."""
    origin: Float32s
    """In the world (R, 3), m."""
    direction: Float32s
    """In the world, of any length (R, 3)."""

    def of(self, chosen: Indices | Mask) -> Rays:
        """Some of the rays."""
        return Rays._make(values[chosen] for values in self)

    def at(self, distance: Float32s) -> Float32s:
        """The points (R, 3) of the rays at distances (R,)."""
        return self.origin + distance[:, None] * self.direction


class Hits(NamedTuple):
    """Where R rays first hit a body."""

    distance: Float32s
    """In multiples of the rays' directions (R,); infinite where nothing is hit."""
    face: Int32s
    """The index of the triangle (R,); -1 where nothing is hit."""
    u: Float32s
    """The coordinates of the point in the triangle (R,)."""
    v: Float32s

    def of(self, chosen: Indices) -> Hits:
        """Some of the hits."""
        return Hits._make(values[chosen] for values in self)

    @classmethod
    def none(cls, count: int) -> Hits:
        """Rays that hit nothing."""
        zero = np.zeros(count, np.float32)
        return cls(zero + np.inf, np.full(count, -1, np.int32), zero, zero.copy())


class Body(NamedTuple):
    """A rigid body for Embree."""

    number: int
    """Its index in the scene."""
    mesh: EmbreeScene
    """Its mesh, in its own frame."""
    first_face: int
    """The index of its first triangle among those of all bodies."""
    corners: Floats
    """The corners of the box around it, in its own frame (8, 3), m."""


class Bodies:
    """The rigid bodies of a scene, and all their triangles.

    Args:
        scene: the scene.
    """

    def __init__(self, scene: Scene) -> None:
        self.all: list[Body] = []
        faces, normals, part_of_face, body_of_face = [], [], [], []
        vertex = face = 0
        for index in np.unique(scene.body_of_part).tolist():
            parts = np.flatnonzero(scene.body_of_part == index).tolist()
            points = [scene.parts[part].placed(scene.on_body[part]) for part in parts]
            own, count = [], 0
            for part, placed in zip(parts, points, strict=True):
                turn = scene.on_body[part][:3, :3].T.astype(np.float32)
                normals.append(scene.parts[part].normals @ turn)
                own.append(scene.parts[part].faces + count)
                part_of_face += [part] * len(own[-1])
                count += len(placed)
            triangles = np.concatenate(own).astype(np.int32)
            mesh = EmbreeScene()
            TriangleMesh(mesh, np.concatenate(points), triangles)
            ends = np.array([np.concatenate(points).min(0), np.concatenate(points).max(0)], float)
            self.all.append(Body(index, mesh, face, np.array(list(itertools.product(*ends.T)))))
            faces.append(triangles + vertex)
            body_of_face += [index] * len(triangles)
            vertex, face = vertex + count, face + len(triangles)
        self._corners = np.concatenate(faces)
        self._normals = np.concatenate(normals)
        self.part_of_face: Int32s = np.array(part_of_face, np.int32)
        """The index of the part of each triangle (F,)."""
        self._body_of_face = np.array(body_of_face, np.int32)

    def normals(self, hits: Hits, arm: Indices, poses: Floats) -> Float32s:
        """The surface normals in the world (R, 3) where rays have hit.

        Args:
            hits: all of them hit something.
            arm: of each ray (R,).
            poses: of the bodies of each arm (N, B, 4, 4).
        """
        first, second, third = (self._normals[self._corners[hits.face, i]] for i in range(3))
        u, v = hits.u[:, None], hits.v[:, None]
        normal = (1.0 - u - v) * first + u * second + v * third
        turns = poses[..., :3, :3].astype(np.float32)[arm, self._body_of_face[hits.face]]
        normal = turned(turns, normal)
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)


def cast(body: Body, poses: Floats, rays: Rays, chosen: Indices, hits: Hits) -> None:
    """Cast some rays at a body, and enter those that hit it before anything else.

    Args:
        body: the body.
        poses: of the bodies of each arm (N, B, 4, 4).
        rays: all rays.
        chosen: the indices of the rays that may hit it.
        hits: of all rays; changed in place.
    """
    if len(chosen) == 0:
        return
    found = body.mesh.run(*_in_frame(body, poses, rays.of(chosen)), query="INTERSECT", output=1)
    nearer = (found["primID"] >= 0) & (found["tfar"] < hits.distance[chosen])
    where = chosen[nearer]
    hits.distance[where] = found["tfar"][nearer]
    hits.face[where] = found["primID"][nearer] + body.first_face
    hits.u[where], hits.v[where] = found["u"][nearer], found["v"][nearer]


def blocked(body: Body, poses: Floats, rays: Rays) -> Mask:
    """Whether a body is in the way of rays (R,)."""
    found = body.mesh.run(*_in_frame(body, poses, rays), query="OCCLUDED")
    return np.asarray(found >= 0)


def _in_frame(body: Body, poses: Floats, rays: Rays) -> tuple[Float32s, Float32s]:
    """The origins and directions of rays in a body's frame, each (R, 3)."""
    pose = poses[:, body.number]
    turn = np.swapaxes(pose[:, :3, :3], 1, 2).astype(np.float32)[rays.arm]
    origin = rays.origin - pose[:, :3, 3].astype(np.float32)[rays.arm]
    return turned(turn, origin), turned(turn, rays.direction)


def turned(turns: Float32s, vectors: Float32s) -> Float32s:
    """Vectors (R, 3), each multiplied by a matrix (R, 3, 3)."""
    return np.asarray(np.einsum("rij,rj->ri", turns, vectors), np.float32)


def boxes(bodies: Sequence[Body], poses: Floats) -> Floats:
    """The corners of the boxes around bodies, in the world (N, len(bodies), 8, 3), m."""
    chosen = poses[:, [body.number for body in bodies]]
    corners = np.array([body.corners for body in bodies]).reshape(-1, 8, 3)
    return np.matmul(corners, np.swapaxes(chosen[..., :3, :3], -1, -2)) + chosen[..., None, :3, 3]
