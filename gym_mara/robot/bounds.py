"""Bounds on where the points of an arm can be, and how far they move."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel


def reach(robot: RobotModel) -> Floats:
    """A bound (J,) on how far any point of the arm moves per unit that a joint moves: m/rad, or 1 if prismatic."""
    found, lengths = np.zeros(robot.num_joints), _lengths(robot)
    for body, point in _points(robot):
        for joint in range(body):
            found[joint] = max(found[joint], lengths[joint + 1 : body].sum() + point)
    found[robot.kinematics().prismatic] = 1.0
    return found


def extent(robot: RobotModel) -> float:
    """A bound on how far any point of the arm can be from the world's origin, m."""
    lengths = _lengths(robot)
    return max(float(lengths[:body].sum() + point) for body, point in _points(robot))


def _lengths(robot: RobotModel) -> Floats:
    """A bound (J,) on how far each joint's origin is from that of the joint before, m; the first from the world's."""
    slides = robot.kinematics().prismatic
    span = np.where(slides, np.maximum(abs(robot.lower), abs(robot.upper)), 0.0)
    return span + [np.linalg.norm(p.translation) for p in robot.model.jointPlacements[1:]]


def _points(robot: RobotModel) -> list[tuple[int, float]]:
    """Bounds on how far the arm's points are from the joint that carries them: joint number, m."""
    frame = robot.model.frames[robot.ee_frame_id]
    points = [(int(frame.parentJoint), float(np.linalg.norm(frame.placement.translation)))]
    for geometry_object in robot.geometry.geometryObjects:
        shape, body = geometry_object.geometry, geometry_object.parentJoint
        if body > 0:
            shape.computeLocalAABB()
            centre = geometry_object.placement.act(shape.aabb_center)
            points.append((body, float(np.linalg.norm(centre) + shape.aabb_radius)))
    return points
