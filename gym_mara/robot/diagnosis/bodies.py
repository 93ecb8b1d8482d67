"""Findings about the bodies that the joints of an arm move: masses and inertias that are missing or that no body has."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from gym_mara.robot.diagnosis.finding import Finding, parts
from gym_mara.robot.inertia import lacks_inertia, lacks_mass, moments
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

_HEAVIEST = 1e4
"""A heavier body is taken for an error, kg."""
_FARTHEST = 1.0
"""A centre of mass may be this far from its link, and twice the link's size, m."""
_ROUNDING = 0.01
"""Moments of inertia may violate the triangle inequality by this share, as rounded ones do."""


def body_findings(robot: RobotModel) -> list[Finding]:
    """The findings about the bodies that the chain's joints move."""
    return [*_missing(robot), *_odd(robot)]


def body_name(robot: RobotModel, number: int) -> str:
    """The name of the link that a joint moves; links fixed to it belong to the same body."""
    frames = (frame for frame in robot.model.frames if frame.parentJoint == number)
    return next(str(frame.name) for frame in frames if frame.type == pin.FrameType.BODY)


def _bodies(robot: RobotModel, which: Callable[[int, pin.Inertia], bool]) -> list[str]:
    """The links that the chain's joints move, of the bodies for which a function of their number and inertia is true."""
    numbers = range(1, robot.num_joints + 1)
    return [body_name(robot, n) for n in numbers if which(n, robot.model.inertias[n])]


def _missing(robot: RobotModel) -> Iterator[Finding]:
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
            "a mass, but no moment of inertia about some axis",
            "the motion is not defined",
            remedy,
            dynamics=True,
        )


def _odd(robot: RobotModel) -> Iterator[Finding]:
    def impossible(_: int, own: pin.Inertia) -> bool:
        low, middle, high = moments(own)
        return bool(not lacks_inertia(own) and low + middle < (1.0 - _ROUNDING) * high)

    sizes = _sizes(robot)
    kinds: tuple[tuple[Callable[[int, pin.Inertia], bool], str, str], ...] = (
        (
            impossible,
            "the largest moment of inertia is larger than the sum of the others, which no body has",
            "no real arm moves so, and MuJoCo refuses it",
        ),
        (
            lambda number, own: bool(
                np.linalg.norm(own.lever) > max(_FARTHEST, 2.0 * sizes[number])
            ),
            "the centre of mass is far outside of the link",
            "the motion is wrong",
        ),
        (
            lambda _, own: bool(own.mass > _HEAVIEST),
            f"a mass of more than {_HEAVIEST:g} kg",
            "the motors may not lift it",
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
