"""The collision checker on python-fcl: pair by pair, an independent referee for the one on Coal."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara.collision.base import CollisionChecker
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.robot.model import RobotModel

with needs("the collision engine 'fcl'", "fcl"):
    import fcl
    import trimesh


class FclChecker(CollisionChecker):
    """python-fcl: boxes, cylinders, spheres and capsules as such, meshes as triangles."""

    def __init__(self, robot: RobotModel) -> None:
        super().__init__(robot)
        self._data = robot.model.createData()
        self._geometry_data = robot.geometry.createData()
        objects = robot.geometry.geometryObjects
        self._objects = [fcl.CollisionObject(_shape(o)) for o in objects]
        self._pairs = [(p.first, p.second) for p in robot.geometry.collisionPairs]
        self._moving = sorted({index for pair in self._pairs for index in pair})
        self._request = fcl.CollisionRequest(num_max_contacts=1)

    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.fromiter((self._collides(row) for row in q), dtype=np.bool_, count=len(q))

    def _collides(self, q: NDArray[np.float64]) -> bool:
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


def _shape(geometry_object: pin.GeometryObject) -> Any:
    """python-fcl's shape of one of Pinocchio's geometry objects."""
    shape = geometry_object.geometry
    kind = type(shape).__name__
    if kind == "Box":
        return fcl.Box(*(2.0 * shape.halfSide))
    if kind == "Cylinder":
        return fcl.Cylinder(shape.radius, 2.0 * shape.halfLength)
    if kind == "Capsule":
        return fcl.Capsule(shape.radius, 2.0 * shape.halfLength)
    if kind == "Sphere":
        return fcl.Sphere(shape.radius)
    if kind.startswith("BVHModel"):
        mesh = trimesh.load_mesh(geometry_object.meshPath)
        model = fcl.BVHModel()
        model.beginModel(len(mesh.vertices), len(mesh.faces))
        model.addSubModel(mesh.vertices * geometry_object.meshScale, mesh.faces)
        model.endModel()
        return model
    raise GymMaraError(
        f"the collision engine 'fcl' does not know the shape {kind} of {geometry_object.name!r}; "
        "use collision='coal'"
    )
