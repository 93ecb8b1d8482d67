"""The ranges of a robot's joints: what an action can ask for, and what the joints can follow."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from gym_mara.types import Floats, Mask

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

_ROUNDED = 1e-4
"""A limit this little beyond ±π, rad, is ±π that was rounded, such as MARA's 3.1416: the range stays ±π."""

_TURN = 2.0 * np.pi
FARTHEST_TURN, FARTHEST_TRAVEL = 4.0 * _TURN, 1e3
"""Limits beyond ± these, rad and m, mean that there are none, or have the wrong unit."""
TRAVEL = 10.0
"""How far such a prismatic joint is moved, m."""


def unlimited(robot: RobotModel) -> Mask:
    """Which joints (J,) have limits so far away that they mean none."""
    prismatic = robot.kinematics().prismatic
    farthest = np.maximum(-robot.lower, robot.upper)
    far: Mask = farthest > np.where(prismatic, FARTHEST_TRAVEL, FARTHEST_TURN)
    return far & (robot.upper - robot.lower > np.where(prismatic, TRAVEL, _TURN))


def useful_limits(robot: RobotModel) -> tuple[Floats, Floats]:
    """The limits, each (J,), rad (m): where they mean none one turn, or TRAVEL of a prismatic joint, around zero if that is allowed."""
    far, lower, upper = unlimited(robot), robot.lower, robot.upper
    span = np.where(robot.kinematics().prismatic, TRAVEL, _TURN)
    low = np.minimum(np.maximum(-0.5 * span, lower), upper - span)
    return np.where(far, low, lower), np.where(far, low + span, upper)


def action_range(robot: RobotModel) -> tuple[Floats, Floats]:
    """The lowest and the highest joint target that an action can ask for, each (J,), rad (m for a prismatic joint).

    A revolute joint has ±π, as in the paper, or its limits if these go beyond ±π. A prismatic joint has its travel, unless it
    cannot move: Gymnasium warns of bounds that are equal. Limits that mean none are those of `useful_limits`.
    """
    lower, upper = useful_limits(robot)
    beyond = (lower < -np.pi - _ROUNDED) | (upper > np.pi + _ROUNDED)
    whole = (robot.kinematics().prismatic & (lower < upper)) | beyond
    return np.where(whole, lower, -np.pi), np.where(whole, upper, np.pi)


def reachable_range(robot: RobotModel) -> tuple[Floats, Floats]:
    """The lowest and the highest configuration that an action can reach, each (J,): its range within the joint limits."""
    low, high = action_range(robot)
    return np.maximum(low, robot.lower), np.minimum(high, robot.upper)


def nearest_turns(robot: RobotModel, q: Floats, near: Floats) -> Floats:
    """Configurations q (…, J), with whole turns added that bring each joint as near to `near` (…, J) as its limits allow.

    Only a revolute joint with a range of more than a turn can have others. What is not finite stays.
    """
    known = np.isfinite(q)
    finite = np.where(known, q, near)
    fewest = np.ceil((robot.lower - finite) / _TURN)
    most = np.floor((robot.upper - finite) / _TURN)
    turns = np.clip(np.round((near - finite) / _TURN), fewest, np.maximum(fewest, most))
    turned = known & ~robot.kinematics().prismatic & (fewest <= most)
    return np.where(turned, finite + _TURN * turns, q)
