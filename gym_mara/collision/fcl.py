"""The collision checker on python-fcl, pair by pair: an independent check of the one on Coal."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.collision.base import CollisionChecker
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Mesh, Sphere
from gym_mara.types import Floats, Mask

with needs("the collision engine 'fcl'", "fcl"):
    import fcl


class FclChecker(CollisionChecker):
    """python-fcl, with meshes as sets of triangles and convex hulls as solids.

    Args:
        robot: the arm.

    Raises:
        GymMaraError: the robot has a shape that python-fcl does not support.
        MissingExtraError: python-fcl is not installed.
    """

    def __init__(self, robot: RobotModel) -> None:
        super().__init__(robot)
        self._data = robot.model.createData()
        self._geometry_data = robot.geometry.createData()
        self._objects = [
            fcl.CollisionObject(_geometry(robot, index)) for index in range(robot.geometry.ngeoms)
        ]
        self._pairs = [(p.first, p.second) for p in robot.geometry.collisionPairs]
        self._moving = sorted({index for pair in self._pairs for index in pair})
        self._request = fcl.CollisionRequest(num_max_contacts=1)

    def check(self, q: Floats) -> Mask:
        return np.fromiter((self._collides(row) for row in q), dtype=np.bool_, count=len(q))

    def _collides(self, q: Floats) -> bool:
        robot = self.robot
        pin.updateGeometryPlacements(
            robot.model, self._data, robot.geometry, self._geometry_data, q
        )
        for index in self._moving:
            pose = self._geometry_data.oMg[index]
            self._objects[index].setTransform(fcl.Transform(pose.rotation, pose.translation))
        return any(
            fcl.collide(self._objects[a], self._objects[b], self._request, fcl.CollisionResult())
            for a, b in self._pairs
        )


def _geometry(robot: RobotModel, index: int) -> Any:
    """python-fcl's geometry of one of the robot's shapes."""
    match robot.shapes[index]:
        case Box(size):
            return fcl.Box(*size)
        case Sphere(radius):
            return fcl.Sphere(radius)
        case Cylinder(radius, length):
            return fcl.Cylinder(radius, length)
        case Capsule(radius, length):
            return fcl.Capsule(radius, length)
        case Mesh(convex=True) as hull:
            # Solid, as in Coal. FCL wants the number of corners before each face's corners.
            corners = np.column_stack([np.full(len(hull.faces), 3), hull.faces])
            return fcl.Convex(hull.vertices, len(hull.faces), corners.ravel())
        case Mesh() as mesh:
            model = fcl.BVHModel()
            model.beginModel(len(mesh.vertices), len(mesh.faces))
            model.addSubModel(mesh.vertices, mesh.faces)
            model.endModel()
            return model
