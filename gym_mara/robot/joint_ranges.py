"""The ranges of a robot's joints: what an action can ask for, and what the joints can follow."""

from __future__ import annotations

import numpy as np

from gym_mara.robot.model import RobotModel
from gym_mara.types import Floats

_ROUNDED = 1e-4
"""A limit this little beyond ±π, rad, is ±π that was rounded, such as MARA's 3.1416: the range stays ±π."""

_TURN = 2.0 * np.pi


def action_range(robot: RobotModel) -> tuple[Floats, Floats]:
    """The lowest and the highest joint target that an action can ask for, each (J,), rad (m for a prismatic joint).

    A revolute joint has ±π, as in the paper, or its limits if these go beyond ±π. A prismatic joint has its travel, unless it
    cannot move: Gymnasium warns of bounds that are equal.
    """
    lower, upper = robot.lower, robot.upper
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
