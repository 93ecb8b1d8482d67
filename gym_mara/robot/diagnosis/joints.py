"""Findings about joints: limits that are missing, zero or too low to hold the arm, and joints that follow others."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from gym_mara.errors import LARGEST, SMALLEST
from gym_mara.robot.diagnosis.finding import Finding, Severity, listed, parts
from gym_mara.robot.diagnosis.sampling import random_configurations
from gym_mara.robot.joint_ranges import FARTHEST_TRAVEL, TRAVEL, unlimited
from gym_mara.types import Mask

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

_NARROWEST = 1e-6
"""A joint with a smaller range cannot move, rad (m)."""
_POSES = 200
"""The number of random poses in which the motors must hold the arm."""
_LIGHTEST = 0.05
"""A body with less mass and without shapes may be driven along unnoticed, kg."""


def joint_findings(robot: RobotModel) -> list[Finding]:
    """The findings about the joints of a loaded arm."""
    findings = _frozen(robot), _unlimited(robot), _limits(robot), _too_weak(robot)
    return [finding for kind in (*findings, _driven_along(robot)) for finding in kind]


def _named(robot: RobotModel, which: Mask) -> list[str]:
    return [robot.joint_names[joint] for joint in np.flatnonzero(which)]


def _frozen(robot: RobotModel) -> Iterator[Finding]:
    if still := _named(robot, robot.upper - robot.lower < _NARROWEST):
        every = len(still) == robot.num_joints
        yield Finding(
            "warning",
            parts("joint", still),
            "the lower limit equals the upper limit, or both are missing",
            "the arm cannot move" if every else "it never moves",
            'Correct the limits, or make the joint type="continuous" or "fixed"',
        )


def _unlimited(robot: RobotModel) -> Iterator[Finding]:
    """Position limits that mean none, or that are in degrees or mm."""
    far, prismatic = unlimited(robot), robot.kinematics().prismatic
    if names := _named(robot, far & ~prismatic):
        yield Finding(
            "warning",
            parts("joint", names),
            "the limits are beyond ±8π rad: are they in degrees, or does it turn without end?",
            "actions and targets have one turn of it",
            'Correct the limits, rad, or make the joint type="continuous"',
        )
    if names := _named(robot, far & prismatic):
        yield Finding(
            "warning",
            parts("joint", names),
            f"the limits are beyond ±{FARTHEST_TRAVEL:g} m",
            f"actions and targets have {TRAVEL:g} m of it",
            "Correct the limits, m",
        )


def _limits(robot: RobotModel) -> Iterator[Finding]:
    """Limits of effort and velocity that are zero or missing."""
    effects = {
        "effort": ("Nm", "a motor without force holds nothing", "the motor is infinitely strong"),
        "velocity": (
            "rad/s",
            "a joint without velocity stands still",
            "it may be faster than a simulation can follow",
        ),
    }
    for word, (unit, standing, endless) in effects.items():
        limits = getattr(robot, f"{word}_limit")
        for which, message, effect, verb in (
            (limits < SMALLEST, f"{word} limit 0", standing, "Correct"),
            (limits >= LARGEST, f"no {word} limit", endless, "Add"),
        ):
            if names := _named(robot, which):
                remedy = f"{verb} <limit>, or give {word}_limit=… ({unit})"
                yield Finding(
                    "error", parts("joint", names), message, effect, remedy, dynamics=True
                )
    unstated: tuple[tuple[Mask, Severity, str], ...] = (
        (robot.velocity_limit < SMALLEST, "warning", "velocity limit 0"),
        (robot.velocity_limit >= LARGEST, "note", "no velocity limit"),
    )
    for which, severity, message in unstated:
        if names := _named(robot, which):
            yield Finding(
                severity,
                parts("joint", names),
                message,
                "where joints jump to their targets it counts as 1 rad/s (m/s)",
                "Correct <limit>, or give velocity_limit=… (rad/s)",
            )


def _too_weak(robot: RobotModel) -> Iterator[Finding]:
    """Motors that cannot hold the arm: at home, or only in other poses."""
    model, data, limit = robot.model, robot.model.createData(), robot.effort_limit
    poses = np.vstack([robot.home, random_configurations(robot, _POSES)])
    weight = np.abs([pin.computeGeneralizedGravity(model, data, q).copy() for q in poses])
    most, limited = weight.max(axis=0), (limit > 0.0) & (limit < LARGEST)
    at_home = limited & (weight[0] > limit)
    units = np.where(robot.kinematics().prismatic, "N", "Nm")
    for which, where, needed in (
        (at_home, "in its start pose", weight[0]),
        (limited & (most > limit) & ~at_home, "in some poses", most),
    ):
        if names := _named(robot, which):
            efforts = [
                f"{limit[joint]:.3g} < {needed[joint]:.3g} {units[joint]}"
                for joint in np.flatnonzero(which)
            ]
            yield Finding(
                "warning",
                parts("joint", names),
                f"the effort limit is below the weight of the arm {where}: {listed(efforts)}",
                "the arm drops",
                "Correct <limit> or the masses, or give effort_limit=… (Nm)",
                dynamics=True,
            )


def _driven_along(robot: RobotModel) -> Iterator[Finding]:
    """Joints that follow others with a part of the arm that can touch something, or that weighs something."""
    with_shapes = {each.parentJoint for each in robot.geometry.geometryObjects}
    names = [
        follower.name
        for number, follower in enumerate(robot.followers, robot.num_joints + 1)
        if number in with_shapes or robot.model.inertias[number].mass >= _LIGHTEST
    ]
    if names:
        yield Finding(
            "note",
            parts("joint", names),
            "mimics a joint of the chain",
            "DART moves it along whatever it touches, and that joint feels no load of it",
            "Nothing is to do, unless it must grasp",
            dynamics=True,
        )
