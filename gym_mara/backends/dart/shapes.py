"""A robot's collision shapes in DART, and the collision detector that works with them.

DART's meshes are surfaces, convex hulls too: a body wholly inside one does not touch it.
"""

from __future__ import annotations

import tempfile
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError, one_of
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Mesh, Shape, Sphere

with needs("the backend 'dart'", "dart"):
    import dartpy as dart
    import trimesh

DETECTORS = {
    "fcl": "FCLCollisionDetector",
    "dart": "DARTCollisionDetector",
    "bullet": "BulletCollisionDetector",
    "ode": "OdeCollisionDetector",
}
_WITH_MESHES = ("fcl", "dart")
"""The detectors that agree with Coal on meshes: Bullet sees contacts 16 mm away, ODE misses bodies deep in a mesh."""
_KEPT = 256
"""The number of DART's meshes that are kept for the next robot."""

Placed = tuple[Any, pin.SE3]
"""A shape of DART and its placement in the frame of the robot's shape."""


class Detector:
    """One of DART's collision detectors, with a robot's shapes; arms of the same robot share it.

    Args:
        name: one of DETECTORS.
        robot: the arm.

    Raises:
        GymMaraError: the detector is unknown, or finds wrong contacts of a shape of the robot.
    """

    def __init__(self, name: str, robot: RobotModel) -> None:
        one_of("detector", name, DETECTORS)
        self.engine = getattr(dart.collision, DETECTORS[name])()
        self.shapes: list[list[Placed]] = []
        """DART's form of each of the robot's collision shapes."""
        for index, shape in enumerate(robot.shapes):
            if isinstance(shape, Mesh) and name not in _WITH_MESHES:
                raise GymMaraError(
                    f"the detector {name!r} finds wrong contacts of meshes, and link {robot.link_of(index)!r} of "
                    f"{robot.name!r} has one; use one of {', '.join(map(repr, _WITH_MESHES))}"
                )
            self.shapes.append(_shapes(shape, name))
        # An engine forgets what it made of a mesh when the last frame with the mesh leaves its groups, and arms clear
        # their groups all the time. These frames stay.
        self._frames: list[Any] = []
        self._group = self.engine.createCollisionGroup()
        for shapes in self.shapes:
            for made, _ in shapes:
                if isinstance(made, dart.dynamics.MeshShape):
                    frame = dart.dynamics.SimpleFrame()
                    frame.setShape(made)
                    self._group.addShapeFrame(frame)
                    self._frames.append(frame)


def _shapes(shape: Shape, detector: str) -> list[Placed]:
    """DART's form of a shape."""
    here = pin.SE3.Identity()
    match shape:
        case Box(size):
            return [(dart.dynamics.BoxShape(size), here)]
        case Sphere(radius):
            return [(dart.dynamics.SphereShape(radius), here)]
        case Cylinder(radius, length):
            return [(dart.dynamics.CylinderShape(radius, length), here)]
        case Capsule(radius, length) if detector == "fcl":
            # DART's FCL has no capsule and would take a small sphere.
            ends = [pin.SE3(np.eye(3), np.array([0.0, 0.0, z])) for z in (-length / 2, length / 2)]
            spheres = [(dart.dynamics.SphereShape(radius), end) for end in ends]
            return [(dart.dynamics.CylinderShape(radius, length), here), *spheres]
        case Capsule(radius, length):
            return [(dart.dynamics.CapsuleShape(radius, length), here)]
        case Mesh() as mesh:
            return [(_mesh(mesh), here)]


@lru_cache(maxsize=_KEPT)
def _mesh(mesh: Mesh) -> Any:
    """DART's form of a mesh. DART reads meshes only from files, and only as parts of a URDF."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.stl"
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(path)
        urdf = (
            f'<robot name="mesh"><link name="mesh"><collision><geometry><mesh filename={quoteattr(str(path))}/>'
            "</geometry></collision></link></robot>"
        )
        skeleton = dart.utils.DartLoader().parseSkeletonString(urdf, "")
    if skeleton is None:
        raise GymMaraError(f"DART cannot read the mesh {mesh.path!r}")
    return skeleton.getBodyNode(0).getShapeNode(0).getShape()
