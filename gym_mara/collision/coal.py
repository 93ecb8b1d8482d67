"""Collision checking by Coal, the library that comes with Pinocchio: on one thread or several, and which links touch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.collision.base import CollisionChecker
from gym_mara.robot import RobotModel
from gym_mara.robot.bounds import joints_to
from gym_mara.robot.description.shapes import Mesh
from gym_mara.robot.geometry import coal_mesh
from gym_mara.types import Floats, Mask


class CoalChecker(CollisionChecker):
    """Coal, the successor of FCL, one configuration at a time.

    It uses the naive broad phase, which measured fastest: an arm has too few bodies for a tree of bounding boxes to pay.

    Args:
        robot: the arm.
        displacement: how far each joint may move (J,), rad. The checker then reports pairs that could meet while no joint
            moves by more than this. None to report pairs that touch.
    """

    def __init__(self, robot: RobotModel, displacement: Floats | None = None) -> None:
        super().__init__(robot)
        self._displacement = displacement
        # The manager holds references to its arguments without keeping them alive.
        self._geometry = robot.geometry if displacement is None else _with_hulls(robot)
        self._data, self._geometry_data = robot.model.createData(), self._geometry.createData()
        if displacement is not None:
            margins = approach_bounds(robot, displacement).tolist()
            for request, margin in zip(self._geometry_data.collisionRequests, margins, strict=True):
                request.security_margin = margin
        self._manager = pin.BroadPhaseManager_NaiveCollisionManager(
            robot.model, self._geometry, self._geometry_data
        )

    def check(self, q: Floats) -> Mask:
        model, data, manager, check = (
            self.robot.model,
            self._data,
            self._manager,
            pin.computeCollisions,
        )
        return np.array([check(model, data, manager, row, True) for row in q], dtype=np.bool_)

    def with_margin(self, displacement: Floats) -> CollisionChecker:
        return CoalChecker(self.robot, displacement)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self._displacement)


def _with_hulls(robot: RobotModel) -> pin.GeometryModel:
    """The robot's collision geometry with the convex hull of each mesh in its place.

    Two hulls are never further apart than their meshes, and Coal finds their distance up to a thousand times faster.
    """
    if not any(isinstance(shape, Mesh) for shape in robot.shapes):
        return robot.geometry
    geometry = robot.geometry.copy()
    for placed, shape in zip(geometry.geometryObjects, robot.shapes, strict=True):
        if isinstance(shape, Mesh):
            placed.geometry = coal_mesh(shape.hull)
    return geometry


def approach_bounds(robot: RobotModel, displacement: Floats) -> Floats:
    """By how much the distance of each collision pair can shrink (P,), m, while joints move by `displacement` (J,), rad.

    Only the joints between the two links of a pair move one relative to the other.
    """
    objects = robot.geometry.geometryObjects
    ways = [frozenset(joints_to(robot.model, body)) for body in range(robot.model.njoints)]
    travel = robot.bounds.travel(displacement)
    bounds = []
    for pair in robot.geometry.collisionPairs:
        one, other = (ways[objects[end].parentJoint] for end in (pair.first, pair.second))
        bounds.append(travel[sorted(one ^ other)].sum())
    return np.array(bounds)


class ParallelCoalChecker(CollisionChecker):
    """Coal on several threads, each with a broad phase of its own.

    It pays for large batches on several idle cores; on busy cores the threads wait for each other. A process that has used
    it must not fork.

    Args:
        robot: the arm.
        threads: how many.
    """

    def __init__(self, robot: RobotModel, threads: int) -> None:
        super().__init__(robot)
        self._threads = threads
        # The only broad phase that Pinocchio runs on several threads.
        self._pool = pin.BroadPhaseManagerPool_DynamicAABBTreeCollisionManager(
            robot.model, robot.geometry, threads
        )

    def check(self, q: Floats) -> Mask:
        result = pin.computeCollisionsInParallel(self._threads, self._pool, q.T, True, False)
        return np.asarray(result, dtype=np.bool_).reshape(len(q))

    def with_margin(self, displacement: Floats) -> CollisionChecker:
        return CoalChecker(self.robot, displacement)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self._threads)


def touching_links(robot: RobotModel, q: Floats) -> frozenset[str]:
    """The links of the collision pairs that touch at a configuration q (J,), rad."""
    data = robot.geometry.createData()
    pin.computeCollisions(robot.model, robot.model.createData(), robot.geometry, data, q, False)
    touching: set[str] = set()
    for pair, result in zip(robot.geometry.collisionPairs, data.collisionResults, strict=True):
        if result.isCollision():
            touching |= {robot.link_of(pair.first), robot.link_of(pair.second)}
    return frozenset(touching)
