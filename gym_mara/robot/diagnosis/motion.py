"""Findings about the joints and bodies of an arm: what cannot move, and what moves otherwise than the arm would."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from gym_mara.errors import LARGEST
from gym_mara.robot.diagnosis.finding import Finding, parts
from gym_mara.robot.inertia import lacks_inertia, lacks_mass, moments
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

_NARROWEST = 1e-6
"""A joint with a smaller range cannot move, rad (m)."""
_HEAVIEST = 1e4
"""A heavier body is taken for an error, kg."""
_FARTHEST = 1.0
"""A centre of mass may be this far from its link, and twice the link's size, m."""
_ROUNDING = 0.01
"""Moments of inertia may violate the triangle inequality by this share, as rounded ones do."""


def motion_findings(robot: RobotModel) -> list[Finding]:
    """The findings about the joints of the chain and the bodies that they move."""
    return [*_joints(robot), *_missing_inertias(robot), *_odd_inertias(robot)]


def _frozen(robot: RobotModel) -> Floats:
    """Which joints (J,) cannot move, because their limits are equal."""
    return np.asarray(robot.upper - robot.lower < _NARROWEST)


def _joints(robot: RobotModel) -> Iterator[Finding]:
    def named(which: Floats) -> list[str]:
        return [robot.joint_names[joint] for joint in np.flatnonzero(which)]

    if still := named(_frozen(robot)):
        every = len(still) == robot.num_joints
        yield Finding(
            "error" if every else "warning",
            parts("joint", still),
            "the lower limit equals the upper limit, or both are missing",
            "the arm cannot move" if every else "it never moves",
            'Correct the limits, or make the joint type="continuous" or "fixed"',
        )
    for name, unit in ("effort_limit", "Nm"), ("velocity_limit", "rad/s"):
        limits = getattr(robot, name)
        word = name.removesuffix("_limit")
        if zero := named(limits <= 0.0):
            yield Finding(
                "error",
                parts("joint", zero),
                f"{word} limit 0",
                "a joint without velocity stands still"
                if word == "velocity"
                else "a motor without force holds nothing",
                f"Correct <limit>, or give {name}=… ({unit})",
                dynamics=True,
            )
        if none := named(limits >= LARGEST):
            yield Finding(
                "note",
                parts("joint", none),
                f"no {word} limit",
                "as fast as its target asks"
                if word == "velocity"
                else "as strong as its motion asks",
                f"Add <limit>, or give {name}=… ({unit})",
                dynamics=True,
            )


def _bodies(robot: RobotModel, which: Callable[[int, pin.Inertia], bool]) -> list[str]:
    """The links that the chain's joints move, of the bodies for which a function of their number and inertia is true."""
    numbers = range(1, robot.num_joints + 1)
    return [body_name(robot, n) for n in numbers if which(n, robot.model.inertias[n])]


def body_name(robot: RobotModel, number: int) -> str:
    """The name of the link that a joint moves; links fixed to it belong to the same body."""
    frames = (frame for frame in robot.model.frames if frame.parentJoint == number)
    return next(str(frame.name) for frame in frames if frame.type == pin.FrameType.BODY)


def _missing_inertias(robot: RobotModel) -> Iterator[Finding]:
    remedy = "Add <inertial>, or give default_mass=… (kg)"
    if links := _bodies(robot, lambda _, own: lacks_mass(own)):
        yield Finding(
            "error",
            parts("link", links),
            "no mass, nor has a link that is fixed to it",
            "a joint that moves no mass never moves",
            remedy,
            dynamics=True,
        )
    if links := _bodies(robot, lambda _, own: not lacks_mass(own) and lacks_inertia(own)):
        yield Finding(
            "error",
            parts("link", links),
            "it has a mass, but no moment of inertia about some axis",
            "its motion is not defined",
            remedy,
            dynamics=True,
        )


def _odd_inertias(robot: RobotModel) -> Iterator[Finding]:
    def impossible(_: int, own: pin.Inertia) -> bool:
        low, middle, high = moments(own)
        return bool(not lacks_inertia(own) and low + middle < (1.0 - _ROUNDING) * high)

    sizes = _sizes(robot)
    kinds: tuple[tuple[Callable[[int, pin.Inertia], bool], str, str], ...] = (
        (
            impossible,
            "its largest moment of inertia is larger than the sum of the others, which no body has",
            "its motion is wrong, and MuJoCo refuses it",
        ),
        (
            lambda number, own: bool(
                np.linalg.norm(own.lever) > max(_FARTHEST, 2.0 * sizes[number])
            ),
            "its centre of mass is far outside of it",
            "its motion is wrong",
        ),
        (
            lambda _, own: bool(own.mass > _HEAVIEST),
            f"its mass is more than {_HEAVIEST:g} kg",
            "its motors may not lift it",
        ),
    )
    for which, message, effect in kinds:
        if links := _bodies(robot, which):
            yield Finding(
                "warning",
                parts("link", links),
                message,
                effect,
                "Correct <inertial>: kg, m and kg·m² about the centre of mass",
                dynamics=True,
            )


def _sizes(robot: RobotModel) -> Floats:
    """How far the farthest point of each body is from its joint, m, by Pinocchio's index; the next joint counts as a point."""
    model = robot.model
    sizes = np.zeros(model.njoints)

    def reaches(body: int, distance: float) -> None:
        sizes[body] = max(sizes[body], distance)

    for number in range(2, model.njoints):
        reaches(
            model.parents[number], float(np.linalg.norm(model.jointPlacements[number].translation))
        )
    for each in robot.geometry.geometryObjects:
        each.geometry.computeLocalAABB()
        centre = each.placement.act(each.geometry.aabb_center)
        reaches(each.parentJoint, float(np.linalg.norm(centre) + each.geometry.aabb_radius))
    return sizes
