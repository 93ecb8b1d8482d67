"""A quick test for large batches that finds most collisions of random configurations, and is never wrong about one.

An arm certainly collides if a ball inside one of its shapes overlaps a fixed box, such as the table. Measured on 1,024 random
actions of MARA: it finds two thirds of the collisions, in 0.4 µs an arm, where Coal takes 5 µs.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from gym_mara.collision.coal import CoalChecker
from gym_mara.robot import RobotModel
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Shape, Sphere
from gym_mara.robot.joint_ranges import action_range
from gym_mara.types import Floats, Mask

_PAIRS = 4
"""At most so many pairs are tested."""
_SAMPLES = 512
"""The number of random configurations that choose the pairs."""
_WORTHWHILE = 0.05
"""A pair is worth its test if it finds this share of the collisions that the others miss."""
_SHRINK = 0.999
"""The balls are smaller by this factor, so that rounding cannot make a contact of a gap."""


class _Pair(NamedTuple):
    """A ball that moves and a box that does not."""

    body: int
    """The number of the joint that moves the ball, from 0."""
    centre: Floats
    """Of the ball in the body's frame (3,), m."""
    radius: float
    """m."""
    rotation: Floats
    """Of the box in the world (3, 3)."""
    position: Floats
    """Of the box in the world (3,), m."""
    half_size: Floats
    """Of the box (3,), m."""


class Overlaps:
    """Finds configurations that certainly collide.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        self._kinematics = robot.kinematics()
        self._pairs = self._best(_candidates(robot))

    def __bool__(self) -> bool:
        """Whether there is any pair to test: arms made of meshes alone have none."""
        return bool(self._pairs)

    def find(self, q: Floats) -> Mask:
        """Which of the configurations q (N, J), rad, certainly collide (N,); others may collide, too."""
        return np.logical_or.reduce(self._overlap(self._pairs, q))

    def _overlap(self, pairs: list[_Pair], q: Floats) -> list[Mask]:
        """For each pair, whose bodies are in descending order, at which configurations it overlaps (N,)."""
        centres = np.array([pair.centre for pair in pairs])
        placed = self._kinematics.points(q, [pair.body for pair in pairs], centres)
        found = []
        for pair, centre in zip(pairs, placed, strict=True):
            outside = np.abs((centre - pair.position) @ pair.rotation) - pair.half_size
            np.maximum(outside, 0.0, out=outside)
            found.append(np.vecdot(outside, outside) < pair.radius**2)
        return found

    def _best(self, candidates: list[_Pair]) -> list[_Pair]:
        """The pairs that together find the most collisions of random actions, each the best of those left."""
        if not candidates:
            return []
        low, high = action_range(self._robot)
        q = np.random.default_rng(0).uniform(low, high, (_SAMPLES, len(low)))
        q = q.clip(self._robot.lower, self._robot.upper)
        missed = CoalChecker(self._robot).check(q)
        enough = _WORTHWHILE * np.count_nonzero(missed)
        found = self._overlap(candidates, q)
        chosen: list[_Pair] = []
        while len(chosen) < _PAIRS:
            gains = [np.count_nonzero(each & missed) for each in found]
            best = int(np.argmax(gains))
            if gains[best] <= enough:
                break
            chosen.append(candidates[best])
            missed &= ~found[best]
        return sorted(chosen, key=lambda pair: -pair.body)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._robot,)


def _candidates(robot: RobotModel) -> list[_Pair]:
    """Every ball in a shape on the chain with every fixed box that may collide with it, the outermost body first."""
    objects = robot.geometry.geometryObjects
    found = []
    for pair in robot.geometry.collisionPairs:
        ends = pair.first, pair.second
        for one, other in (ends, ends[::-1]):
            moving, fixed = objects[one], objects[other]
            if not 1 <= moving.parentJoint <= robot.num_joints or fixed.parentJoint != 0:
                continue
            box = robot.shapes[other]
            if isinstance(box, Box):
                ball = _ball(robot.shapes[one])
                if ball > 0.0:
                    found.append(_pair(moving, ball, fixed, box))
    return sorted(found, key=lambda pair: -pair.body)


def _pair(moving: pin.GeometryObject, radius: float, fixed: pin.GeometryObject, box: Box) -> _Pair:
    return _Pair(
        body=moving.parentJoint - 1,
        centre=moving.placement.translation.copy(),
        radius=_SHRINK * radius,
        rotation=fixed.placement.rotation.copy(),
        position=fixed.placement.translation.copy(),
        half_size=0.5 * np.asarray(box.size),
    )


def _ball(shape: Shape) -> float:
    """The radius of the largest ball around the origin that lies in a shape, m; 0 for a mesh, which may be hollow."""
    match shape:
        case Box(size):
            return 0.5 * float(np.min(size))
        case Sphere(radius) | Capsule(radius):
            return radius
        case Cylinder(radius, length):
            return min(radius, 0.5 * length)
    return 0.0
