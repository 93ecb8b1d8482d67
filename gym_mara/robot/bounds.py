"""Bounds on how far the joints of an arm move its points, which say when links could meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from gym_mara.robot.description.off_chain import Follower
from gym_mara.robot.kinematics import motion_axis
from gym_mara.types import Floats


@dataclass(frozen=True, eq=False)
class Bounds:
    """How far the B joints of a model move its points. The first J are the chain, the others follow one of it."""

    leaders: tuple[int, ...]
    """For each joint the joint of the chain that it follows, from 0: itself in the chain (B,)."""
    ratios: Floats
    """How far each joint moves per unit of the one that it follows (B,)."""
    of_joints: Floats
    """How far any point moves per unit that a joint moves (B,): m/rad, or 1 if prismatic."""
    reach: Floats
    """How far any point moves per unit that a joint of the chain moves, with those that follow it (J,)."""
    extent: float
    """How far any point can be from the world's origin, m."""

    @classmethod
    def of(
        cls,
        model: pin.Model,
        geometry: pin.GeometryModel,
        ee_frame_id: int,
        followers: Sequence[Follower],
    ) -> Bounds:
        """The bounds of a model's end-effector frame and collision shapes."""
        chain = model.nq
        leaders = (*range(chain), *(follower.leader for follower in followers))
        ratios = np.abs([1.0] * chain + [follower.multiplier for follower in followers])
        slides = np.array([not motion_axis(joint)[3:].any() for joint in model.joints[1:]])
        lengths = _lengths(model, followers, slides)
        of_joints, reach, extent = np.zeros(len(leaders)), np.zeros(chain), 0.0
        for body, distance in _points(model, geometry, ee_frame_id):
            way = joints_to(model, body)
            extent = max(extent, float(lengths[way].sum() + distance))
            moved = np.zeros(chain)
            for index, joint in enumerate(way):
                bound = 1.0 if slides[joint] else lengths[way[index + 1 :]].sum() + distance
                of_joints[joint] = max(of_joints[joint], bound)
                moved[leaders[joint]] += ratios[joint] * bound
            reach = np.maximum(reach, moved)
        reach[slides[:chain]] = np.maximum(reach[slides[:chain]], 1.0)
        return cls(leaders, ratios, of_joints, reach, extent)

    def travel(self, displacement: Floats) -> Floats:
        """How far each joint moves any point (B,), m, while the chain's joints move by `displacement` (J,), rad (m)."""
        travel: Floats = self.of_joints * self.ratios * displacement[list(self.leaders)]
        return travel


def joints_to(model: pin.Model, body: int) -> list[int]:
    """The joints that move a body, from 0, from the base on.

    Args:
        model: Pinocchio's model.
        body: Pinocchio's index of the joint that carries the body; 0 for the base.
    """
    way: list[int] = []
    while body > 0:
        way.insert(0, body - 1)
        body = model.parents[body]
    return way


def _lengths(model: pin.Model, followers: Sequence[Follower], slides: Floats) -> Floats:
    """A bound (B,) on how far each joint's origin is from that of the joint before, m; the first from the world's."""
    span = np.maximum(abs(model.lowerPositionLimit), abs(model.upperPositionLimit))
    further = [abs(f.multiplier) * span[f.leader] + abs(f.offset) for f in followers]
    spans = np.where(slides, np.concatenate([span, further]), 0.0)
    distances: Floats = spans + [np.linalg.norm(p.translation) for p in model.jointPlacements[1:]]
    return distances


def _points(
    model: pin.Model, geometry: pin.GeometryModel, ee_frame_id: int
) -> list[tuple[int, float]]:
    """Bounds on how far the arm's points are from the joint that carries them: Pinocchio's index of the joint, m."""
    frame = model.frames[ee_frame_id]
    points = [(int(frame.parentJoint), float(np.linalg.norm(frame.placement.translation)))]
    for geometry_object in geometry.geometryObjects:
        shape, body = geometry_object.geometry, geometry_object.parentJoint
        if body > 0:
            shape.computeLocalAABB()
            centre = geometry_object.placement.act(shape.aabb_center)
            points.append((body, float(np.linalg.norm(centre) + shape.aabb_radius)))
    return points
