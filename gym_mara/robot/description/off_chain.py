"""Joints off the chain: they are locked, or follow a joint of the chain that they mimic."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError
from gym_mara.robot.description.joints import axis_of, limits_of, vector, within_limits
from gym_mara.types import Floats

_MOVING = ("revolute", "continuous", "prismatic")
# A fixed joint does not need them, and urdfdom rejects some that are incomplete.
_OF_MOTION = ("axis", "limit", "mimic", "dynamics", "safety_controller", "calibration")
_FARTHEST = 1e12
"""Where a joint may be locked, or how fast it may follow: the products of larger numbers may overflow."""


class Follower(NamedTuple):
    """A joint off the chain that mimics one of it: its position is multiplier · q[leader] + offset."""

    name: str
    leader: int
    """The number of the joint of the chain, from 0."""
    multiplier: float
    offset: float
    """rad (m for a prismatic joint)."""

    def position(self, q: Floats) -> float:
        """Where it is, rad (m), at positions q (J,) of the chain."""
        return float(self.multiplier * q[self.leader] + self.offset)

    def velocity(self, qd: Floats) -> float:
        """How fast it is, rad/s (m/s), at velocities q̇ (J,) of the chain."""
        return float(self.multiplier * qd[self.leader])


def keep_chain(
    urdf: Path,
    root: ElementTree.Element,
    chain: Sequence[str],
    locked: Mapping[str, Sequence[float]],
) -> tuple[Follower, ...]:
    """Change a URDF so that only a chain of joints moves, and those that mimic one of it; return the latter.

    Other joints become fixed, within their limits. Continuous joints become revolute between -π and π.

    Args:
        urdf: the file, for errors.
        root: the URDF.
        chain: the names of the joints, of `find_chain`.
        locked: joint name → position, rad (m), of joints off the chain; the others are locked at 0.

    Raises:
        GymMaraError: a joint mimics itself or an unknown joint or has no direction, or its limits are in the wrong order.
    """
    joints = {joint.get("name", ""): joint for joint in root.findall("joint")}
    positions = {name: _position(urdf, joints, chain, locked, name) for name in joints}
    for name, joint in joints.items():
        if name in chain:
            if joint.get("type") == "continuous":
                _make_revolute(joint)
        elif positions[name].leader < 0:
            _fix(urdf, joint, positions[name].offset)
        else:
            axis_of(urdf, joint)
            _follow(joint, chain[positions[name].leader], positions[name])
    return tuple(p for name, p in positions.items() if name not in chain and p.leader >= 0)


def _position(
    urdf: Path,
    joints: Mapping[str, ElementTree.Element],
    chain: Sequence[str],
    locked: Mapping[str, Sequence[float]],
    name: str,
) -> Follower:
    """The position of any joint as a function of the chain's; the leader is -1 where it is locked."""
    multiplier, offset = 1.0, 0.0
    passed = [name]
    while name not in chain:
        joint = joints[name]
        mimic = joint.find("mimic")
        if joint.get("type") not in _MOVING or mimic is None:
            offset += multiplier * _lock(urdf, joint, locked.get(name, ()))
            multiplier = 0.0
            break
        offset += multiplier * float(mimic.get("offset", "0"))
        multiplier *= float(mimic.get("multiplier", "1"))
        name = mimic.get("joint", "")
        if name in passed or name not in joints:
            what = "itself" if name in passed else f"{name!r}, which is no joint"
            raise GymMaraError(f"{str(urdf)!r}: joint {passed[-1]!r} mimics {what}")
        passed.append(name)
    if max(abs(multiplier), abs(offset)) > _FARTHEST:
        raise GymMaraError(
            f"{str(urdf)!r}: joint {passed[0]!r} mimics {name!r} with the multiplier {multiplier:g} and the offset {offset:g}; "
            f"at most {_FARTHEST:g} is allowed"
        )
    return Follower(passed[0], chain.index(name) if multiplier else -1, multiplier, offset)


def _lock(urdf: Path, joint: ElementTree.Element, position: Sequence[float]) -> float:
    """Where to lock a joint: at a position, else at 0, within its limits."""
    if joint.get("type") not in _MOVING:
        return 0.0
    at = position[0] if len(position) == 1 else 0.0
    if joint.get("type") == "continuous":
        return at
    lower, upper = limits_of(urdf, joint)
    limit = joint.find("limit")
    if limit is None or not {"lower", "upper"} & limit.attrib.keys():
        return at
    return within_limits(at, lower, upper, turns=joint.get("type") == "revolute")


def _fix(urdf: Path, joint: ElementTree.Element, position: float) -> None:
    """Make a joint fixed at a position, rad (m)."""
    if position:
        origin = joint.find("origin")
        if origin is None:
            origin = ElementTree.SubElement(joint, "origin")
        xyz, rpy = (vector(origin.get(name, "0 0 0")) for name in ("xyz", "rpy"))
        rotation, axis = pin.rpy.rpyToMatrix(rpy), axis_of(urdf, joint)
        if joint.get("type") == "prismatic":
            xyz = xyz + rotation @ axis * position
        else:
            rpy = pin.rpy.matrixToRpy(rotation @ pin.exp3(axis * position))
        origin.set("xyz", " ".join(map(repr, xyz.tolist())))
        origin.set("rpy", " ".join(map(repr, rpy.tolist())))
    joint.set("type", "fixed")
    for child in [child for child in joint if child.tag in _OF_MOTION]:
        joint.remove(child)


def _follow(joint: ElementTree.Element, leader: str, follower: Follower) -> None:
    """Make a joint follow one of the chain, without limits of its own."""
    joint.set("type", "prismatic" if joint.get("type") == "prismatic" else "revolute")
    for child in [child for child in joint if child.tag in _OF_MOTION and child.tag != "axis"]:
        joint.remove(child)
    free = {"upper": "1e12", "effort": "1e12", "velocity": "1e12"}
    ElementTree.SubElement(joint, "limit", {"lower": "-1e12", **free})
    numbers = {"multiplier": repr(follower.multiplier), "offset": repr(follower.offset)}
    ElementTree.SubElement(joint, "mimic", {"joint": leader, **numbers})


def _make_revolute(joint: ElementTree.Element) -> None:
    joint.set("type", "revolute")
    limit = joint.find("limit")
    if limit is None:
        limit = ElementTree.SubElement(joint, "limit", effort="1e9", velocity="1e9")
    limit.set("lower", repr(-np.pi))
    limit.set("upper", repr(np.pi))
