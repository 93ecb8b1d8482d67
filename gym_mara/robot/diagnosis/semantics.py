"""Findings about an SRDF: what it names that the URDF lacks, and a home pose that the arm cannot take."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from gym_mara.robot.description.joints import ROUNDED
from gym_mara.robot.description.srdf import Semantics
from gym_mara.robot.diagnosis.finding import Finding, listed, parts

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

_FEW = 5
"""An SRDF of which the URDF has less than a fifth describes another robot."""
_TURN = 2.0 * np.pi


def semantics_findings(
    robot: RobotModel, semantics: Semantics, root: ElementTree.Element
) -> list[Finding]:
    """The findings about an SRDF.

    Args:
        robot: the arm.
        semantics: what its SRDF says.
        root: the URDF.
    """
    return [*_unknown_names(robot, semantics, root), *_home(robot, semantics)]


def _unknown_names(
    robot: RobotModel, semantics: Semantics, root: ElementTree.Element
) -> Iterator[Finding]:
    unknown = semantics.unknown_names(root)
    if not unknown:
        return
    named = semantics.names
    known = len(named) - len(unknown)
    if _FEW * known >= len(named):
        message = f"it names links or joints that the URDF lacks: {listed(unknown)}"
        remedy = "Correct them, unless the SRDF describes a larger robot"
    else:
        message = (
            "it seems to describe another robot: the URDF has "
            f"{known} of the {len(named)} links and joints that it names"
        )
        remedy = "Give this robot's own SRDF, or remove it"
    effect = "what the URDF lacks is ignored"
    yield Finding("warning", f"SRDF {str(robot.srdf)!r}", message, effect, remedy)


def _home(robot: RobotModel, semantics: Semantics) -> Iterator[Finding]:
    pose = semantics.home_pose(robot.joint_names)
    partial = [each for each in semantics.poses if each.values.keys() & set(robot.joint_names)]
    if partial and not pose.values:
        lacking = [joint for joint in robot.joint_names if joint not in partial[0].values]
        yield Finding(
            "note",
            f"SRDF {str(robot.srdf)!r}",
            f"no pose names every joint of the chain; {partial[0].name!r} lacks {listed(lacking)}",
            "the start pose is zero, within the limits",
            "Add the joints to a pose, or give start_q=[…]",
        )
    way = np.subtract(semantics.home(robot.joint_names), robot.home)
    turned = np.where(robot.kinematics().prismatic, way, way - _TURN * np.round(way / _TURN))
    beyond = np.abs(turned) > ROUNDED
    if pose.values and beyond.any():
        yield Finding(
            "warning",
            parts("joint", [robot.joint_names[joint] for joint in np.flatnonzero(beyond)]),
            f"the SRDF's pose {pose.name!r} puts it beyond its limits",
            "the start pose has it at the limit",
            "Correct the pose or the limits",
        )
