"""Findings about what a URDF writes of its joints and a loaded arm does not have any more."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import pinocchio as pin

from gym_mara.robot.description.joints import ROUNDED
from gym_mara.robot.description.off_chain import Follower
from gym_mara.robot.diagnosis.finding import Finding, listed, parts

_ENDS = ("lower", "upper")


class Written(NamedTuple):
    """What a URDF writes of its joints, by their names."""

    kinds: Mapping[str, str]
    """Their types."""
    limits: Mapping[str, Mapping[str, float]]
    """The position limits "lower" and "upper" of revolute and prismatic joints, rad (m)."""
    soft: Mapping[str, Mapping[str, float]]
    """Those of <safety_controller>."""


def written_joints(root: ElementTree.Element) -> Written:
    """What a URDF writes of its joints."""
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    kinds = {name: joint.get("type", "") for name, joint in joints.items()}
    limited = {name: j for name, j in joints.items() if kinds[name] in ("revolute", "prismatic")}
    return Written(
        kinds,
        {name: _ends(joint, "limit", "{}") for name, joint in limited.items()},
        {name: _ends(j, "safety_controller", "soft_{}_limit") for name, j in limited.items()},
    )


def _ends(joint: ElementTree.Element, tag: str, attribute: str) -> dict[str, float]:
    """The numbers of these attributes for "lower" and "upper"; without those that are missing or no finite numbers."""
    element, ends = joint.find(tag), {}
    for end in _ENDS if element is not None else ():
        try:
            ends[end] = float(element.get(attribute.format(end), ""))  # type: ignore[union-attr]
        except ValueError:
            continue
    return {end: value for end, value in ends.items() if math.isfinite(value)}


def range_findings(
    written: Written, chain: Sequence[str], followers: Sequence[Follower], model: pin.Model
) -> list[Finding]:
    """The findings about the ranges of joints.

    Args:
        written: what the URDF writes.
        chain: the names of the joints of the chain.
        followers: the joints that mimic one of it.
        model: Pinocchio's model.
    """
    return [
        *_half_limited(written, chain),
        *_endless(written, chain),
        *_softer(written, chain),
        *_beyond(written, followers, model),
        *_loose(written),
    ]


def _half_limited(written: Written, chain: Sequence[str]) -> Iterator[Finding]:
    for end, other in (_ENDS, _ENDS[::-1]):
        limits = {name: written.limits.get(name, {}) for name in chain}
        if names := [name for name in chain if [*limits[name]] == [other]]:
            remedy = f'Add {end}="…" to <limit>'
            message = f"<limit> has {other}=, but no {end}="
            yield Finding("warning", parts("joint", names), message, "it counts as 0", remedy)


def _endless(written: Written, chain: Sequence[str]) -> Iterator[Finding]:
    if names := [name for name in chain if written.kinds[name] == "continuous"]:
        yield Finding(
            "note",
            parts("joint", names),
            "continuous, without end stops",
            "it has the limits ±π rad here, and positions beyond them are refused",
            "Nothing is to do; turn a real arm that stands beyond ±π back first",
        )


def _softer(written: Written, chain: Sequence[str]) -> Iterator[Finding]:
    """Soft limits that are narrower; equal ones, such as 0 and 0, are not meant."""
    shown = {}
    for name in chain:
        limits, soft = written.limits.get(name, {}), written.soft.get(name, {})
        low, high = (limits.get(end, 0.0) for end in _ENDS)
        inner = max(low, soft.get("lower", low)), min(high, soft.get("upper", high))
        if inner[0] < inner[1] and (inner[0] > low + ROUNDED or inner[1] < high - ROUNDED):
            shown[name] = f"{name} [{inner[0]:.4g}, {inner[1]:.4g}]"
    if shown:
        yield Finding(
            "note",
            parts("joint", list(shown)),
            f"the soft limits of <safety_controller> are narrower than <limit>: {listed(list(shown.values()))}",
            "they do not count: targets may be where a controller that keeps them does not go",
            "Write them in <limit>, if the arm's controller keeps them",
        )


def _beyond(written: Written, followers: Sequence[Follower], model: pin.Model) -> Iterator[Finding]:
    names = []
    for follower in followers:
        ends = model.lowerPositionLimit[follower.leader], model.upperPositionLimit[follower.leader]
        low, high = sorted(follower.multiplier * end + follower.offset for end in ends)
        own = written.limits.get(follower.name, {})
        if low < own.get("lower", low) - ROUNDED or high > own.get("upper", high) + ROUNDED:
            names.append(follower.name)
    if names:
        yield Finding(
            "note",
            parts("joint", names),
            "the range of the joint that it mimics moves it beyond its own limits",
            "its own limits do not count",
            "Correct <limit> or <mimic>, unless this is meant",
        )


def _loose(written: Written) -> Iterator[Finding]:
    """Joints of several degrees of freedom, which are never in the chain."""
    for kind in ("floating", "planar"):
        if names := [name for name, own in written.kinds.items() if own == kind]:
            yield Finding(
                "note",
                parts("joint", names),
                kind,
                "it is locked at its origin, and its link is an obstacle there",
                "Remove its link if nothing is there",
            )
