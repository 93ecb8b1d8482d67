"""Which pairs of links touch, and how often, in random poses of an arm; always the same poses for an arm."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from gym_mara.robot.collision_pairs import Pair, keep_pairs, link_of, linked
from gym_mara.robot.description.shapes import Mesh
from gym_mara.robot.joint_ranges import useful_limits
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

POSES = 1000
"""The number of random poses on which a share is measured."""
OFTEN = 0.5
"""Two moving links that touch in a larger share of the poses do so by a fault of the description; arms without one that were
tried have at most 0.2."""
ALWAYS = 0.95
"""The same for a link that does not move, such as a table, which an arm may well touch in most of its poses."""
_STAGES = (16, 128)
"""Only pairs that touch in half of this share of the first 16 poses, then of the first 128, are tried in all."""


def random_configurations(robot: RobotModel, count: int) -> Floats:
    """Random configurations (N, J) within the limits of an arm, rad; fewer are the first of more."""
    lower, upper = useful_limits(robot)
    # A joint of several turns is drawn from one of them.
    wide = ~robot.kinematics().prismatic & (upper - lower > 2.0 * np.pi)
    low = np.where(wide, np.clip(-np.pi, lower, upper - 2.0 * np.pi), lower)
    high = np.where(wide, low + 2.0 * np.pi, upper)
    return np.random.default_rng(0).uniform(low, high, (count, robot.num_joints))


class Poses:
    """Counts the touching pairs of links in random poses of an arm.

    Args:
        robot: the arm.
        pairs: the pairs of links.
    """

    def __init__(self, robot: RobotModel, pairs: Iterable[Pair]) -> None:
        self.pairs = frozenset(pairs)
        self._model, self._all = robot.model, robot.geometry.copy()
        self._all.removeAllCollisionPairs()
        self._all.addAllCollisionPairs()
        keep_pairs(self._model, self._all, self.pairs)

    def count(self, q: Floats, pairs: Iterable[Pair] | None = None) -> Counter[Pair]:
        """In how many of the configurations q (N, J) each pair touches; all pairs, or these."""
        geometry = self._all
        if pairs is not None:
            geometry = geometry.copy()
            keep_pairs(self._model, geometry, pairs)
        of_links = np.array(linked(self._model, geometry), object)
        found: Counter[Pair] = Counter()
        if not len(of_links):
            return found
        model_data, data = self._model.createData(), geometry.createData()
        for row in q:
            if pin.computeCollisions(self._model, model_data, geometry, data, row, False):
                hits = [result.isCollision() for result in data.collisionResults]
                found.update(set(of_links[np.flatnonzero(hits)].tolist()))
        return found


def moving_links(robot: RobotModel) -> set[str]:
    """The links with shapes that a joint moves."""
    objects = robot.geometry.geometryObjects
    return {link_of(robot.model, each) for each in objects if each.parentJoint}


def limit_of(pair: Pair, moving: set[str]) -> float:
    """The share of random poses above which a pair that touches does so by a fault of the description."""
    return OFTEN if pair <= moving else ALWAYS


def often_touching(robot: RobotModel) -> dict[Pair, float]:
    """The checked pairs that touch in most random poses, and in which share of them."""
    return dict(_often_touching(_Arm(robot, _key(robot))))


def shares(robot: RobotModel, pairs: frozenset[Pair]) -> dict[Pair, float]:
    """In which share of random poses these pairs touch."""
    return dict(_shares(_Arm(robot, _key(robot)), pairs))


@dataclass(frozen=True)
class _Arm:
    """An arm, equal to another if their pairs touch in the same poses."""

    robot: RobotModel = field(compare=False)
    key: tuple[Any, ...]


def _key(robot: RobotModel) -> tuple[Any, ...]:
    """What decides when links touch; a mesh that was read once is the same object."""
    meshes = tuple(shape for shape in robot.shapes if isinstance(shape, Mesh))
    return robot.xml, robot.collision_pairs, meshes


@lru_cache(maxsize=16)
def _often_touching(arm: _Arm) -> dict[Pair, float]:
    robot = arm.robot
    moving, poses = moving_links(robot), Poses(robot, robot.collision_pairs)
    pairs, q = robot.collision_pairs, random_configurations(robot, POSES)
    for stage in _STAGES:
        counts = poses.count(q[:stage], pairs)
        pairs = frozenset(p for p in pairs if counts[p] > 0.5 * limit_of(p, moving) * stage)
    counts = poses.count(q, pairs)
    return {p: counts[p] / POSES for p in pairs if counts[p] > limit_of(p, moving) * POSES}


@lru_cache(maxsize=16)
def _shares(arm: _Arm, pairs: frozenset[Pair]) -> dict[Pair, float]:
    poses = Poses(arm.robot, pairs)
    q = random_configurations(arm.robot, _STAGES[-1])
    counts = poses.count(q)
    return {pair: counts[pair] / len(q) for pair in pairs}
