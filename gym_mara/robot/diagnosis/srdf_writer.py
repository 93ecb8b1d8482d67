"""Writes an SRDF as MoveIt's setup assistant does: the pairs of links that need no check are found in random poses."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from gym_mara.robot.collision_pairs import Pair, joined
from gym_mara.robot.diagnosis.sampling import (
    ALWAYS,
    POSES,
    Poses,
    limit_of,
    moving_links,
    random_configurations,
)

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

MOST_POSES = 10_000
"""The number of random poses in which two links must not touch, to be disabled as "Never"."""


def disabled_pairs(robot: RobotModel) -> dict[Pair, str]:
    """The pairs of links that need no check, in alphabetical order, and why, in MoveIt's words.

    "Adjacent": one joint joins them. "Always": they touch in 95 % of the poses. "Default": they touch in the start pose.
    "Often", which is not MoveIt's: two moving links that touch in half of the poses. "Never": they touch in none.
    """
    moving, neighbours = moving_links(robot), joined(ElementTree.fromstring(robot.xml))
    poses = Poses(robot, robot.collision_pairs | robot.excluded_pairs.keys())
    q, at_home = random_configurations(robot, MOST_POSES), poses.count(robot.home[None])
    counts = poses.count(q[:POSES])
    never = poses.pairs - counts.keys() - at_home.keys() - neighbours
    for start in range(POSES, MOST_POSES, POSES):
        never -= poses.count(q[start : start + POSES], never).keys()
    reasons = {}
    for pair in sorted(poses.pairs, key=sorted):
        if pair in neighbours:
            reasons[pair] = "Adjacent"
        elif counts[pair] >= ALWAYS * POSES:
            reasons[pair] = "Always"
        elif pair in at_home:
            reasons[pair] = "Default"
        elif counts[pair] > limit_of(pair, moving) * POSES:
            reasons[pair] = "Often"
        elif pair in never:
            reasons[pair] = "Never"
    return reasons


def srdf_text(robot: RobotModel, disabled: Mapping[Pair, str]) -> str:
    """An SRDF of an arm: its chain, end effector and home pose, and these pairs of links.

    Args:
        robot: the arm.
        disabled: the pairs that are never checked for collision, and why.
    """
    urdf = ElementTree.fromstring(robot.xml)
    first = next(j for j in urdf.findall("joint") if j.get("name") == robot.joint_names[0])
    base = first.find("parent")
    chain = _tag(
        "chain", base_link="" if base is None else base.get("link", ""), tip_link=robot.ee_frame
    )
    values = zip(robot.joint_names, robot.home.tolist(), strict=True)
    states = [f"    {_tag('joint', name=name, value=repr(value))}" for name, value in values]
    pairs = []
    for pair, reason in disabled.items():
        one, other = sorted(pair)
        pairs.append("  " + _tag("disable_collisions", link1=one, link2=other, reason=reason))
    return "\n".join(
        [
            '<?xml version="1.0"?>',
            f"<!-- Pairs of links in {POSES:,} random poses; those that never touched, in {MOST_POSES:,}. -->",
            f"<robot name={quoteattr(urdf.get('name', ''))}>",
            f'  <group name="arm">{chain}</group>',
            '  <group_state name="home" group="arm">',
            *states,
            "  </group_state>",
            "  " + _tag("end_effector", name="tool", parent_link=robot.ee_frame, group="arm"),
            *pairs,
            "</robot>\n",
        ]
    )


def _tag(element: str, /, **attributes: str) -> str:
    """An empty element."""
    return (
        f"<{element} {' '.join(f'{key}={quoteattr(value)}' for key, value in attributes.items())}/>"
    )
