"""Does an arm collide at these configurations? One small interface, and the engines behind it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from gym_mara.errors import GymMaraError, unknown
from gym_mara.robot.model import RobotModel


class CollisionChecker(ABC):
    """Checks the pairs of links that may collide, the scene's links among them."""

    def __init__(self, robot: RobotModel) -> None:
        self.robot = robot

    @abstractmethod
    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether any pair touches, (N,), at each of the configurations q (N, J), rad."""

    def with_room(self, displacement: NDArray[np.float64]) -> CollisionChecker | None:
        """A checker for which pairs touch already that could meet while no joint moves further than `displacement` (J,), rad.

        None where the engine cannot tell.
        """
        return None

    def __reduce__(self) -> tuple[Any, ...]:
        # Engines' objects do not pickle; the robot says it all.
        return type(self), (self.robot,)

    def __deepcopy__(self, memo: dict[int, Any]) -> CollisionChecker:
        make, arguments = self.__reduce__()
        copied: CollisionChecker = make(*arguments)
        return copied


def make_checker(name: str, robot: RobotModel, threads: int = 1) -> CollisionChecker:
    """The checker of this name: "coal", "fcl", or "none", which sees no collision.

    Args:
        name: the engine.
        robot: the arm.
        threads: how many threads Coal may use for many configurations.

    Raises:
        GymMaraError: the name is neither, or the engine has no such number of threads.
        MissingExtraError: the engine is not installed.
    """
    if threads < 1 or (threads > 1 and name != "coal"):
        raise GymMaraError(
            f"collision_threads must be at least 1, and 1 but for 'coal'; not {threads} for {name!r}"
        )
    if name == "coal":
        return CoalChecker(robot) if threads == 1 else ParallelCoalChecker(robot, threads)
    if name == "fcl":
        from gym_mara.robot.fcl import FclChecker

        return FclChecker(robot)
    if name == "none":
        return NoChecker(robot)
    raise unknown("collision engine", name, ("coal", "fcl", "none"))


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


class NoChecker(CollisionChecker):
    """Sees no collision, and costs nothing."""

    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.zeros(len(q), dtype=np.bool_)

    def with_room(self, displacement: NDArray[np.float64]) -> CollisionChecker:
        return self


class RememberingChecker(CollisionChecker):
    """Spares the checks of arms that stay where there is known to be room around them; the answers are the same.

    For many arms, each always in the same row, as a policy keeps them that has learnt where to go: where nothing can touch
    while no joint moves further than NEARBY, nothing needs to be checked while none does.

    Args:
        robot: the arm.
        exact: what checks the others.
    """

    NEARBY = 0.01
    """rad (m for a prismatic joint)."""

    def __init__(self, robot: RobotModel, exact: CoalChecker | ParallelCoalChecker) -> None:
        super().__init__(robot)
        self._exact = exact
        self._with_room = CoalChecker(robot, np.full(robot.num_joints, self.NEARBY))
        # Per arm: where it was last, where it was last looked for room, and where room was found; NaN is near nothing.
        self._last: NDArray[np.float64] = np.empty((0, robot.num_joints))
        self._looked = self._free = self._last

    def check(self, q: NDArray[np.float64]) -> NDArray[np.bool_]:
        if len(q) != len(self._last):
            self._last = np.full(q.shape, np.nan)
            self._looked, self._free = self._last.copy(), self._last.copy()
        collided = np.zeros(len(q), dtype=np.bool_)
        unsure = ~self._near(q, self._free)
        if unsure.any():
            collided[unsure] = self._exact.check(q[unsure])
            # Only arms that stay about are worth a look, and only one look at each place.
            stays = unsure & ~collided & self._near(q, self._last)
            look = np.flatnonzero(stays & ~self._near(q, self._looked))
            if len(look):
                self._looked[look] = q[look]
                roomy = look[~self._with_room.check(q[look])]
                self._free[roomy] = q[roomy]
        self._last = q.copy()
        return collided

    def _near(self, q: NDArray[np.float64], place: NDArray[np.float64]) -> NDArray[np.bool_]:
        return np.asarray((np.abs(q - place) <= self.NEARBY).all(axis=1))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.robot, self._exact)


def touching_links(robot: RobotModel, q: NDArray[np.float64]) -> frozenset[str]:
    """The links that touch another at a configuration q (J,), rad, of the pairs that may collide."""
    data = robot.geometry.createData()
    pin.computeCollisions(robot.model, robot.model.createData(), robot.geometry, data, q, False)
    touching: set[str] = set()
    for pair, result in zip(robot.geometry.collisionPairs, data.collisionResults, strict=True):
        if result.isCollision():
            touching |= {robot.link_of(pair.first), robot.link_of(pair.second)}
    return frozenset(touching)
