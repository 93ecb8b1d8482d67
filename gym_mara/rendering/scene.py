"""The parts of a scene, their poses and colours: the arm, its surroundings, and the frames of target and tool."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara.extras import needs
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere
from gym_mara.types import Floats

with needs("rendering", "render", "trimesh"):
    import trimesh

Colour = tuple[float, float, float]

COLLIDING: Colour = (0.86, 0.10, 0.08)
"""The colour of links that collide."""
_AXES: tuple[Colour, ...] = ((0.90, 0.16, 0.16), (0.18, 0.66, 0.22), (0.16, 0.36, 0.90))
_DEFAULT: Colour = (0.7, 0.7, 0.72)
"""The colour of a mesh whose file has none."""
_CIRCLE_SIDES = 48
"""The number of sides of the polygon that approximates a circle."""


@dataclass(frozen=True, eq=False)
class Part:
    """One rigid shape of one colour."""

    name: str
    link: str
    """The link that the part belongs to; "target" or "tool" for a frame that is drawn there."""
    vertices: NDArray[np.float32]
    """Vertex positions in the part's own frame (V, 3), m."""
    normals: NDArray[np.float32]
    """Outward unit normals at the vertices (V, 3)."""
    faces: NDArray[np.int32]
    """Triangles (F, 3), as indices of vertices."""
    colour: Colour
    """RGB in [0, 1]."""
    fixed: bool = False
    """Whether the part never moves."""
    marker: bool = False
    """Whether the part is only drawn, and is no physical body."""

    def placed(self, placement: Floats) -> NDArray[np.float32]:
        """The vertices in the world frame (V, 3), m, for a part with this pose, a homogeneous matrix (4, 4)."""
        rotation, position = placement[:3, :3].astype(np.float32), placement[:3, 3]
        return self.vertices @ rotation.T + position.astype(np.float32)


class Scene:
    """The parts of a robot's scene, with their poses and colours.

    Args:
        robot: the arm.

    Raises:
        GymMaraError: a mesh of the robot cannot be read.
        MissingExtraError: trimesh is not installed.
    """

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot
        self._model, self._data = robot.model, robot.model.createData()
        geometry, shapes = robot.visual
        parts: list[Part] = []
        bodies: list[int] = []
        placements: list[Floats] = []
        for placed, shape in zip(geometry.geometryObjects, shapes, strict=True):
            link = str(self._model.frames[placed.parentFrame].name)
            for mesh, colour in _meshes_of(placed, shape):
                name = f"{placed.name}/{len(parts)}"
                parts.append(_part(name, link, mesh, colour, fixed=placed.parentJoint == 0))
                bodies.append(placed.parentJoint)
                placements.append(placed.placement.homogeneous)
        scale = self.marker_scale = _marker_scale(robot)
        """The size of markers relative to those of MARA."""
        tool = self._model.frames[robot.ee_frame_id]
        for marker, body, placement in (
            (_frame("target", 0.14 * scale, 0.006 * scale), self._model.njoints, np.eye(4)),
            (
                _frame("tool", 0.09 * scale, 0.003 * scale),
                tool.parentJoint,
                tool.placement.homogeneous,
            ),
        ):
            parts += marker
            bodies += [body] * len(marker)
            placements += [placement] * len(marker)
        self.parts: tuple[Part, ...] = tuple(parts)
        self.body_of_part: NDArray[np.int32] = np.array(bodies, np.int32)
        """The rigid body of each part (P,): 0 for what is fixed, then the bodies of the joints, at last the target."""
        self.on_body: Floats = np.array(placements)
        """The pose of each part on its body, homogeneous matrices (P, 4, 4)."""

    def placements(self, view: View) -> Floats:
        """The pose of each part in the world frame, homogeneous matrices (P, 4, 4)."""
        placed: Floats = self.bodies(view)[self.body_of_part] @ self.on_body
        return placed

    def bodies(self, view: View) -> Floats:
        """The pose of each rigid body in the world frame, homogeneous matrices (B, 4, 4)."""
        pin.forwardKinematics(self._model, self._data, view.q)
        target = np.eye(4)
        target[:3, :3] = pin.Quaternion(*view.target_quaternion).matrix()
        target[:3, 3] = view.target_position
        return np.array([*(placement.homogeneous for placement in self._data.oMi), target])

    def colours(self, view: View) -> list[Colour]:
        """The colour of each part; links that collide are red."""
        return [
            COLLIDING if part.link in view.touching and not part.marker else part.colour
            for part in self.parts
        ]

    def points(self, view: View) -> Floats:
        """The vertices of all parts in the world frame (V, 3), m."""
        pairs = zip(self.parts, self.placements(view), strict=True)
        return np.concatenate([part.placed(placement) for part, placement in pairs], dtype=float)

    def swept(self, q: Floats) -> Floats:
        """Where the arm is at configurations (N, J): the corners of boxes around its moving bodies (V, 3), m, in the world frame."""
        vertices: dict[int, list[NDArray[np.float32]]] = {}
        for part, body, placement in zip(self.parts, self.body_of_part, self.on_body, strict=True):
            if not part.fixed and not part.marker:
                vertices.setdefault(int(body) - 1, []).append(part.placed(placement))
        boxes = {body: _corners(np.concatenate(own)) for body, own in vertices.items()}
        placed = [np.empty((0, 3))]
        # `Kinematics` places the bodies of the chain; joints that mimic one of it come after it.
        if chain := sorted((b for b in boxes if b < self.robot.num_joints), reverse=True):
            corners = np.concatenate([boxes[body] for body in chain])
            points = self.robot.kinematics().points(q, np.repeat(chain, 8).tolist(), corners)
            placed.append(points.reshape(-1, 3))
        if followers := [body for body in boxes if body >= self.robot.num_joints]:
            for row in q:
                pin.forwardKinematics(self._model, self._data, row)
                for body in followers:
                    at = self._data.oMi[body + 1]
                    placed.append(boxes[body] @ at.rotation.T + at.translation)
        return np.concatenate(placed)


def _corners(points: NDArray[np.float32]) -> Floats:
    """The corners (8, 3) of the box around points (V, 3), along the axes."""
    ends = np.array([points.min(axis=0), points.max(axis=0)], float)
    return np.array(list(itertools.product(*ends.T)))


def _marker_scale(robot: RobotModel) -> float:
    """The size of the markers relative to those of MARA, which is 1.2 m long; to two digits, so that MARA's is 1."""
    turning = robot.reach[~robot.kinematics().prismatic]
    return float(f"{(turning.max() if len(turning) else robot.extent) / 1.2:.2g}")


def _meshes_of(placed: pin.GeometryObject, shape: Shape) -> list[tuple[trimesh.Trimesh, Colour]]:
    """The meshes of a visual shape, in its frame, each with its colour."""
    red, green, blue, _ = np.asarray(placed.meshColor, float).tolist()
    own: Colour = (red, green, blue)
    if not isinstance(shape, Mesh):
        return [(_with_creases(_primitive(shape)), own)]
    # STL and hulls have no vertex normals, so creases are found by angle; the other formats store them.
    unshaded = shape.convex or shape.path.lower().endswith(".stl")
    return [
        (
            _with_creases(part) if unshaded else part,
            own if placed.overrideMaterial else _colour_of(part),
        )
        for part in shape.parts
    ]


def _primitive(shape: Box | Sphere | Cylinder | Capsule) -> trimesh.Trimesh:
    """The mesh of a URDF primitive."""
    match shape:
        case Box(size):
            return trimesh.creation.box(size)
        case Sphere(radius):
            return trimesh.creation.icosphere(subdivisions=3, radius=radius)
        case Cylinder(radius, length):
            return trimesh.creation.cylinder(radius, length, sections=_CIRCLE_SIDES)
        case Capsule(radius, length):
            mesh = trimesh.creation.capsule(length, radius, count=(_CIRCLE_SIDES, _CIRCLE_SIDES))
            mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
            return mesh


def _with_creases(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The mesh with its vertices duplicated along sharp edges, so that normals are not averaged across them."""
    return trimesh.graph.smooth_shade(mesh, angle=np.radians(30.0))


def _colour_of(mesh: Any) -> Colour:
    """The colour that the mesh file defines."""
    if mesh.visual.kind == "texture":
        rgba = np.asarray(mesh.visual.material.main_color, float)
    elif mesh.visual.kind in ("face", "vertex"):
        rgba = np.asarray(mesh.visual.main_color, float)
    else:
        return _DEFAULT
    red, green, blue = (rgba[:3] / 255.0).tolist()
    return red, green, blue


def _part(
    name: str,
    link: str,
    mesh: trimesh.Trimesh,
    colour: Colour,
    *,
    fixed: bool = False,
    marker: bool = False,
) -> Part:
    return Part(
        name=name,
        link=link,
        vertices=np.ascontiguousarray(mesh.vertices, np.float32),
        normals=np.ascontiguousarray(mesh.vertex_normals, np.float32),
        faces=np.ascontiguousarray(mesh.faces, np.int32),
        colour=colour,
        fixed=fixed,
        marker=marker,
    )


def _frame(link: str, length: float, radius: float) -> list[Part]:
    """A coordinate frame, drawn as three rods: x red, y green, z blue."""
    parts = []
    for axis, colour in enumerate(_AXES):
        ends = np.zeros((2, 3))
        ends[1, axis] = length
        rod = trimesh.creation.cylinder(radius=radius, segment=ends, sections=16)
        name = f"{link}/{'xyz'[axis]}"
        parts.append(_part(name, link, _with_creases(rod), colour, marker=True))
    return parts
