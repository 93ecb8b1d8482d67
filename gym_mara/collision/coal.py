"""Coal, the collision library that comes with Pinocchio: on one thread, on several, and which links touch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara.collision.base import CollisionChecker
from gym_mara.robot import RobotModel


class CoalChecker(CollisionChecker):
    """Coal, FCL's successor that Pinocchio ships, one configuration at a time.

    Its plainest broad phase is the fastest here: an arm has too few bodies for a tree of their boxes to pay.

    Args:
        robot: the arm.
        displacement: how far each joint may move (J,), rad: pairs count as touching that could meet while none moves
            further. None for pairs that touch.
    """

    def __init__(self, robot: RobotModel, displacement: NDArray[np.float64] | None = None) -> None:
        super().__init__(robot)
        self._displacement = displacement
        # The manager refers to what it is given, and does not keep it alive.
        self._data, self._geometry_data = robot.model.createData(), robot.geometry.createData()
        if displacement is not None:
            margins = approach_bounds(robot, displacement).tolist()
            for request, margin in zip(self._geometry_data.collisionRequests, margins, strict=True):
                request.security_margin = margin
        self._manager = pin.BroadPhaseManager_NaiveCollisionManager(
            robot.model, robot.geometry, self._geometry_data
        )

    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        model, data, manager, check = (
            self.robot.model,
            self._data,
            self._manager,
            pin.computeCollisions,
        )
        return np.array([check(model, data, manager, row, True) for row in q], dtype=np.bool_)

    def with_room(self, displacement: NDArray[np.float64]) -> CollisionChecker:
        return CoalChecker(self.robot, displacement)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self._displacement)


def approach_bounds(robot: RobotModel, displacement: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much nearer the two ends of each collision pair can come (P,), m, while joints move by `displacement` (J,), rad.

    Seen from one end, only the joints between the two move the other.
    """
    model, objects = robot.model, robot.geometry.geometryObjects
    joints_to: list[frozenset[int]] = [frozenset()]
    for body in range(1, model.njoints):
        joints_to.append(joints_to[model.parents[body]] | {body - 1})
    length = robot.reach * displacement
    bounds = []
    for pair in robot.geometry.collisionPairs:
        one, other = (joints_to[objects[end].parentJoint] for end in (pair.first, pair.second))
        bounds.append(length[sorted(one ^ other)].sum())
    return np.array(bounds)


class ParallelCoalChecker(CollisionChecker):
    """Coal with a broad phase per thread.

    Worth it for large batches on several idle cores: on a busy one the threads wait for each other, and a process that
    has used them must not fork.
    """

    def __init__(self, robot: RobotModel, threads: int) -> None:
        super().__init__(robot)
        self._threads = threads
        # The only broad phase that Pinocchio spreads over threads.
        self._pool = pin.BroadPhaseManagerPool_DynamicAABBTreeCollisionManager(
            robot.model, robot.geometry, threads
        )

    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        result = pin.computeCollisionsInParallel(self._threads, self._pool, q.T, True, False)
        return np.asarray(result, dtype=np.bool_).reshape(len(q))

    def with_room(self, displacement: NDArray[np.float64]) -> CollisionChecker:
        return CoalChecker(self.robot, displacement)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self._threads)


def touching_links(robot: RobotModel, q: NDArray[np.float64]) -> frozenset[str]:
    """The links that touch another at a configuration q (J,), rad, of the pairs that may collide."""
    data = robot.geometry.createData()
    pin.computeCollisions(robot.model, robot.model.createData(), robot.geometry, data, q, False)
    touching: set[str] = set()
    for pair, result in zip(robot.geometry.collisionPairs, data.collisionResults, strict=True):
        if result.isCollision():
            touching |= {robot.link_of(pair.first), robot.link_of(pair.second)}
    return frozenset(touching)
