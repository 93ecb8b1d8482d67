"""The fingerprint of a robot: equal for equal arms, wherever their files are."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from gym_mara.robot.description.shapes import Mesh
from gym_mara.robot.kinematics import motion_axis
from gym_mara.robot.model import RobotModel

_DECIMALS = 9
"""Numbers are rounded, because a library computes the last digits differently on another machine."""


def fingerprint(robot: RobotModel) -> str:
    """The SHA-256, in hexadecimal, of what a simulation uses of a robot.

    These are the placements, axes, limits and inertias of its joints, its home pose, its end-effector frame, its collision
    shapes with the vertices of their meshes, and the pairs of links that may collide. Comments and the places of files do
    not count.
    """
    digest = hashlib.sha256()

    def add(*values: Any) -> None:
        for value in values:
            digest.update(value.encode() if isinstance(value, str) else _bytes(value))
            digest.update(b";")

    model = robot.model
    frame = model.frames[robot.ee_frame_id]
    add(*robot.joint_names, frame.parentJoint, frame.placement.homogeneous)
    add(robot.lower, robot.upper, robot.velocity_limit, robot.effort_limit, robot.home)
    add(model.friction, model.damping, model.armature)
    for joint, placement in zip(model.joints[1:], model.jointPlacements[1:], strict=True):
        add(placement.homogeneous, motion_axis(joint))
    for follower in robot.followers:
        add(follower.name, *follower[1:])
    for inertia in model.inertias:
        add(inertia.mass, inertia.lever, inertia.inertia)
    for geometry_object, shape in zip(robot.geometry.geometryObjects, robot.shapes, strict=True):
        add(
            type(shape).__name__, geometry_object.parentJoint, geometry_object.placement.homogeneous
        )
        if isinstance(shape, Mesh):
            # In one order, and each once: libraries that read meshes differ in this.
            add(float(shape.convex), np.unique(shape.vertices.round(_DECIMALS) + 0.0, axis=0))
        else:
            add(*(value for _, value in sorted(vars(shape).items())))
    add(*sorted("+".join(sorted(pair)) for pair in robot.collision_pairs))
    return digest.hexdigest()


def _bytes(value: ArrayLike) -> bytes:
    """A number or array as bytes; adding zero turns -0 into 0."""
    return np.ascontiguousarray(
        np.asarray(value, np.float64).round(_DECIMALS) + 0.0, "<f8"
    ).tobytes()
