"""How near an arm is to a collision, and which way its joints lead out of it.

A collision checker answers yes or no. For an observation this is too little: it says nothing until it is too late. So links are
covered by spheres, whose distances have a gradient and cost little for many arms at once. The spheres follow the collision shapes
roughly; whether an arm collides is decided by a checker.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.arrays import Constants
from gym_mara.robot.description.shapes import Box, Capsule, Cylinder, Shape, Sphere
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.robot.kinematics import JointFrames
from gym_mara.robot.model import RobotModel
from gym_mara.types import Floats

WIDTH = 0.06
"""The distance over which the repulsion of two spheres falls by a factor of e, m."""
FAR = 0.3
"""The largest distance that is reported, m."""
_SAMPLES = 512
"""The number of random configurations that choose the pairs."""
_STILL, _NEAR = 1e-3, 0.05
"""A pair counts if its distance varies by more than the first and falls below the second in some configuration, m."""


class _Spheres(NamedTuple):
    """Spheres on the bodies of an arm."""

    body: list[int]
    """The number of the joint that moves each one, from 0, in ascending order (S,)."""
    shape: list[int]
    """The number of the collision shape that each one covers (S,)."""
    centre: Floats
    """In the frames of the bodies (S, 3), m."""
    radius: Floats
    """(S,), m."""


class Clearance:
    """The distance of an arm's spheres from each other and from the boxes around fixed shapes.

    Bodies that follow a joint of the chain have no spheres: JointFrames does not have where they are.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self._robot = robot
        spheres = _spheres(robot)
        self._counts = [spheres.body.count(joint) for joint in range(robot.num_joints)]
        self._centres = Constants(spheres.centre)
        allowed = _allowed(robot)
        shapes = np.array(spheres.shape, np.intp)
        one, other = np.nonzero(np.triu(allowed[np.ix_(shapes, shapes)], 1))
        low, high = reachable_range(robot)
        q = np.random.default_rng(0).uniform(low, high, (_SAMPLES, robot.num_joints))
        placed = self._placed(robot.kinematics().joint_frames(q))
        chosen = _matter(
            np.sqrt(((placed[one] - placed[other]) ** 2).sum(axis=1))
            - (spheres.radius[one] + spheres.radius[other])[:, None]
        )
        one, other = one[chosen], other[chosen]
        pairs = np.arange(len(one))
        difference = np.zeros((len(one), len(shapes)))
        difference[pairs, one], difference[pairs, other] = 1.0, -1.0
        reach = spheres.radius[one] + spheres.radius[other]
        self._pairs = Constants(difference, reach[:, None])
        bodies = np.array(spheres.body)
        ends = np.stack([bodies[one], bodies[other]], axis=1)
        self._of_pairs = _members(ends, robot.num_joints)
        self._boxes: list[Constants] = []
        self._of_boxes: list[Members] = []
        for shape, (rotation, position, half) in _boxes(robot).items():
            against = np.flatnonzero(allowed[shape, shapes])
            distance = _from_box(np, placed[against], rotation, position[:, None], half[:, None])[1]
            near = against[_matter(distance - spheres.radius[against, None])]
            if len(near):
                select = np.eye(len(shapes))[near]
                radius = spheres.radius[near, None]
                self._boxes.append(
                    Constants(select, rotation, position[:, None], half[:, None], radius)
                )
                self._of_boxes.append(_members(bodies[near, None], robot.num_joints))
        outer = np.array(spheres.body)[None] >= np.arange(robot.num_joints)[:, None]
        slides = robot.kinematics().prismatic.astype(np.float64)[:, None]
        self._joints = Constants(outer.astype(np.float64), slides, FAR, WIDTH)

    def __call__(self, frames: JointFrames) -> tuple[Floats, Floats]:
        """The least distance of each body, and the repulsion, of N arms.

        Args:
            frames: of `Kinematics.joint_frames`.

        Returns:
            The least distance of the body that each joint moves (N, J), m, at most FAR, negative where spheres overlap; and -∂U/∂q (N, J) of the potential
            U = Σ w e^(-d/w) over all pairs with distance d, with w = WIDTH: to follow it leads away from the nearest pairs.
        """
        xp, outer, slides, far, width = self._joints.like(frames.position)
        centre = self._placed(frames)
        spheres, _, count = centre.shape
        least = [xp.zeros_like(frames.position[:, 0]) + far] * len(outer)
        force = xp.zeros_like(centre)
        members = [self._of_pairs] if self._of_pairs else []
        groups = zip([*members, *self._of_boxes], self._groups(xp, centre), strict=True)
        for of_bodies, (spread, apart, length, distance) in groups:
            for body, own in of_bodies.items():
                least[body] = xp.minimum(least[body], xp.min(distance[own], axis=0))
            push = apart * (xp.exp(-distance / width) / length)[:, None]
            force = force + (spread @ push.reshape(len(push), -1)).reshape(spheres, 3, count)
        # The virtual work of the forces on all that a joint moves: their sum along its axis, or their moment about it.
        moment = xp.linalg.cross(centre, force, axis=1)
        total, turn = (
            xp.permute_dims(
                (outer @ each.reshape(spheres, 3 * count)).reshape(len(outer), 3, count), (2, 0, 1)
            )
            for each in (force, moment)
        )
        about = turn - xp.linalg.cross(frames.origins, total)
        return xp.stack(least, axis=-1), xp.sum(
            frames.axes * (about + slides * (total - about)), axis=-1
        )

    def _groups(self, xp: Any, centre: Floats) -> Iterator[tuple[Floats, Floats, Floats, Floats]]:
        """The pairs of spheres, then those of spheres with each box.

        Args:
            xp: the namespace of the arrays.
            centre: of the spheres in the world (S, 3, N), m.

        Yields:
            The matrix that adds the forces of P pairs to those of the spheres (S, P); the way from the one of a pair to the
            other (P, 3, N), m; its length (P, N), m; and their distance (P, N), m.
        """
        spheres, _, count = centre.shape
        flat = centre.reshape(spheres, 3 * count)
        _, select, reach = self._pairs.like(centre)
        if len(select):
            apart = (select @ flat).reshape(-1, 3, count)
            length = xp.sqrt(xp.sum(apart * apart, axis=1) + _TINY)
            yield select.T, apart, length, length - reach
        for box in self._boxes:
            _, select, rotation, position, half, radius = box.like(centre)
            own = (select @ flat).reshape(-1, 3, count)
            apart, length = _from_box(xp, own, rotation, position, half)
            yield select.T, apart, length, length - radius

    def _placed(self, frames: JointFrames) -> Floats:
        """The centres of the spheres in the world (S, 3, N), m."""
        xp, centres = self._centres.like(frames.position)
        placed, start = [], 0
        for joint, number in enumerate(self._counts):
            axes, origin = frames.bodies[joint, :3], frames.bodies[joint, 3]
            own = centres[start : start + number] @ axes.reshape(3, -1)
            placed.append(own.reshape(number, *origin.shape) + origin)
            start += number
        return xp.concat(placed)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self._robot,)


Members = dict[int, list[int]]
"""The pairs of each body that has any."""


def _members(bodies: NDArray[np.intp], joints: int) -> Members:
    """The pairs of each body, for the bodies of each pair (P, 1) or (P, 2)."""
    found = {body: np.flatnonzero((bodies == body).any(axis=1)).tolist() for body in range(joints)}
    return {body: pairs for body, pairs in found.items() if pairs}


def _from_box(
    xp: Any, points: Floats, rotation: Floats, position: Floats, half: Floats
) -> tuple[Floats, Floats]:
    """The ways from a box to points (S, 3, N) outside of it, in the world, and their lengths (S, N), m.

    Args:
        xp: the namespace of the arrays.
        points: in the world, m.
        rotation: of the box (3, 3).
        position: of its centre (3, 1), m.
        half: half of its lengths (3, 1), m.
    """
    inside = rotation.T @ (points - position)
    outside = inside - xp.minimum(xp.maximum(inside, -half), half)
    return rotation @ outside, xp.sqrt(xp.sum(outside * outside, axis=-2) + _TINY)


_TINY = 1e-12
"""m²; a point inside a box has no way from it, and would divide by zero."""


def _matter(distance: Floats) -> NDArray[np.bool_]:
    """Which pairs (P,) come near and do not stand still, for their distances in random configurations (P, N), m."""
    return (distance.min(axis=1) < _NEAR) & (np.ptp(distance, axis=1) > _STILL)


def _allowed(robot: RobotModel) -> NDArray[np.bool_]:
    """Which collision shapes are checked against each other (G, G)."""
    allowed = np.zeros((len(robot.shapes), len(robot.shapes)), np.bool_)
    for pair in robot.geometry.collisionPairs:
        allowed[pair.first, pair.second] = allowed[pair.second, pair.first] = True
    return allowed


def _spheres(robot: RobotModel) -> _Spheres:
    """Spheres in a row along the longest side of the box around each moving shape."""
    found = []
    for number, (placed, shape) in enumerate(
        zip(robot.geometry.geometryObjects, robot.shapes, strict=True)
    ):
        joint = placed.parentJoint - 1
        if not 0 <= joint < robot.num_joints:
            continue
        middle, half = _box(shape)
        long = int(half.argmax())
        radius = float(np.delete(half, long).max())
        rest = half[long] - radius
        for along in np.linspace(-rest, rest, max(1, math.ceil(half[long] / radius))):
            centre = middle.copy()
            centre[long] += along
            found.append((joint, number, placed.placement.act(centre), radius))
    found.sort(key=lambda sphere: sphere[0])
    body, shape_of, centre, size = zip(*found, strict=True) if found else ((), (), (), ())
    return _Spheres([*body], [*shape_of], np.reshape(centre, (-1, 3)), np.array(size, np.float64))


def _boxes(robot: RobotModel) -> dict[int, tuple[Floats, Floats, Floats]]:
    """The box around each fixed shape by the shape's number: rotation (3, 3), position (3,), m, half of its lengths (3,), m."""
    boxes = {}
    for number, (placed, shape) in enumerate(
        zip(robot.geometry.geometryObjects, robot.shapes, strict=True)
    ):
        if placed.parentJoint == 0:
            middle, half = _box(shape)
            boxes[number] = placed.placement.rotation.copy(), placed.placement.act(middle), half
    return boxes


def _box(shape: Shape) -> tuple[Floats, Floats]:
    """The middle of the box around a shape, and half of its lengths, each (3,), m."""
    match shape:
        case Box(size):
            return np.zeros(3), 0.5 * np.asarray(size)
        case Sphere(radius):
            return np.zeros(3), np.full(3, radius)
        case Cylinder(radius, length):
            return np.zeros(3), np.array([radius, radius, 0.5 * length])
        case Capsule(radius, length):
            return np.zeros(3), np.array([radius, radius, 0.5 * length + radius])
    corners = shape.vertices.min(axis=0), shape.vertices.max(axis=0)
    return 0.5 * (corners[0] + corners[1]), 0.5 * (corners[1] - corners[0])
