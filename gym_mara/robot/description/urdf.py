"""Reads a URDF as one chain of joints and builds Pinocchio's model of it.

Joints off the chain are locked by making them fixed in the URDF's XML, not by Pinocchio's `buildReducedModel`, which was
tried on every robot of the catalogue. It fails where a locked joint and a link have the same name (so100's gripper) and
rejects locked joints without limits. Elsewhere it makes the same model, but sums inertias in another order, so that they
differ in the last bits. And the XML must be changed anyway: Pinocchio stores the angle of a continuous joint as its cosine
and sine.
"""

from __future__ import annotations

import os
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError, short
from gym_mara.files import plain_size
from gym_mara.robot.description.mesh_files import candidates

# More than any robot has; the number of pairs of shapes grows with the square.
_MOST = {"link": 1000, "joint": 1000, "collision": 500}
_MOST_IN_CHAIN = 100
_LARGEST_NUMBER = 1e12
"""Of a URDF: the products of larger ones may overflow."""
_LARGEST_MESHES = 2**30
"""The size of all mesh files of a robot together, bytes."""
_ANY, _NOT_NEGATIVE = -_LARGEST_NUMBER, 0.0
# Element → attribute → the least value of its numbers.
_NUMBERS: dict[str, dict[str, float]] = {
    "origin": {"xyz": _ANY, "rpy": _ANY},
    "axis": {"xyz": _ANY},
    "limit": {"lower": _ANY, "upper": _ANY, "effort": _NOT_NEGATIVE, "velocity": _NOT_NEGATIVE},
    "box": {"size": _NOT_NEGATIVE},
    "sphere": {"radius": _NOT_NEGATIVE},
    "cylinder": {"radius": _NOT_NEGATIVE, "length": _NOT_NEGATIVE},
    "capsule": {"radius": _NOT_NEGATIVE, "length": _NOT_NEGATIVE},
    "mesh": {"scale": _ANY},
    "mass": {"value": _NOT_NEGATIVE},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), _ANY),
}
_COUNT = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3}
"""How many numbers an attribute has; the others have one."""


def check_urdf(urdf: Path, root: ElementTree.Element, package_dirs: Sequence[str] = ()) -> None:
    """Check a URDF before Pinocchio reads it: how much it holds, its numbers, and its mesh files.

    Raises:
        GymMaraError: there are too many links or shapes, a number is not finite or out of range, or a mesh is not a plain
            file or too large.
    """
    for tag, most in _MOST.items():
        found = sum(1 for _ in root.iter(tag))
        if found > most:
            raise GymMaraError(
                f"{str(urdf)!r} has {found:,} elements <{tag}>; at most {most:,} are allowed"
            )
    for part in root:
        if part.tag in ("link", "joint"):
            for element in part.iter():
                for name, least in _NUMBERS.get(element.tag, {}).items():
                    text = element.get(name)
                    if text is not None and not _is_number(text, name, least):
                        raise GymMaraError(
                            f"{str(urdf)!r}: <{element.tag}> of {part.tag} {part.get('name')!r} has {name}={short(text)}; "
                            f"{_COUNT.get(name, 1)} finite number(s) from {least:g} to {_LARGEST_NUMBER:g} are allowed"
                        )
    names = {mesh.get("filename", "") for mesh in root.iter("mesh")} - {""}
    places = (place for name in names for place in candidates(urdf, name, package_dirs))
    if sum(plain_size(place) for place in places if os.path.lexists(place)) > _LARGEST_MESHES:
        raise GymMaraError(
            f"the meshes of {str(urdf)!r} are larger than {_LARGEST_MESHES:,} bytes together"
        )


def _is_number(text: str, name: str, least: float) -> bool:
    """Whether the value of an attribute has as many numbers as it must have, from `least` to the largest allowed."""
    try:
        numbers = [float(part) for part in text.split()]
    except ValueError:
        return False
    return len(numbers) == _COUNT.get(name, 1) and all(
        least <= number <= _LARGEST_NUMBER for number in numbers
    )


def ee_frame_among_links(urdf: Path, root: ElementTree.Element, ee_frame: str | None) -> str:
    """The name of the end-effector frame, checked to be one of the URDF's links.

    Raises:
        GymMaraError: the URDF has no link of that name, or no name is given.
    """
    links = [link.get("name", "") for link in root.iter("link")]
    if ee_frame is None:
        raise GymMaraError(
            f"name the end-effector link of {str(urdf)!r} (ee_frame=…), one of: {', '.join(links)}"
        )
    if ee_frame not in links:
        raise GymMaraError(
            f"{str(urdf)!r} has no link {ee_frame!r} for the end-effector frame; it has: {', '.join(links)}"
        )
    return ee_frame


def make_chain(urdf: Path, root: ElementTree.Element, ee_frame: str) -> list[str]:
    """Change the URDF so that only the chain to the end-effector frame moves; return the names of its joints.

    Joints off the chain become fixed. Continuous joints become revolute between -π and π.

    Raises:
        GymMaraError: no moving joint leads to the frame, or a joint of an unsupported type does.
    """
    joints = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None:
            raise GymMaraError(
                f"{str(urdf)!r}: joint {joint.get('name')!r} lacks a parent or child"
            )
        joints[child.get("link")] = (joint, parent.get("link"))
    chain: list[str] = []
    link: str | None = ee_frame
    passed = []
    while link in joints:
        passed.append(link)
        joint, link = joints.pop(link)
        kind = "mimic" if joint.find("mimic") is not None else joint.get("type")
        if kind == "continuous":
            _make_revolute(joint)
        elif kind not in ("revolute", "prismatic", "fixed"):
            raise GymMaraError(
                f"{str(urdf)!r} is not a fixed-base chain to {ee_frame!r}: joint {joint.get('name')!r} "
                f"is {kind}; only revolute, continuous, prismatic and fixed joints may lead there"
            )
        if kind != "fixed":
            _check_motion(urdf, joint)
            chain.insert(0, joint.get("name", ""))
    if link in passed:
        raise GymMaraError(
            f"{str(urdf)!r}: the joints that lead to {ee_frame!r} form a loop at {link!r}"
        )
    if not chain:
        raise GymMaraError(
            f"{str(urdf)!r}: no moving joint leads to {ee_frame!r}; name a link that the arm moves"
        )
    if len(chain) > _MOST_IN_CHAIN:
        raise GymMaraError(
            f"{str(urdf)!r}: {len(chain)} joints lead to {ee_frame!r}; at most {_MOST_IN_CHAIN} are allowed"
        )
    for joint, _ in joints.values():
        joint.set("type", "fixed")
    return chain


def _check_motion(urdf: Path, joint: ElementTree.Element) -> None:
    """Raises GymMaraError if a joint has no direction, or its limits are in the wrong order."""
    axis, limit = joint.find("axis"), joint.find("limit")
    if axis is not None and not any(float(x) for x in axis.get("xyz", "1").split()):
        raise GymMaraError(
            f"{str(urdf)!r}: the axis of joint {joint.get('name')!r} has length zero"
        )
    if limit is not None:
        lower, upper = (float(limit.get(end, "0")) for end in ("lower", "upper"))
        if lower > upper:
            raise GymMaraError(
                f"{str(urdf)!r}: joint {joint.get('name')!r} has the lower limit {lower:g}, above its upper limit {upper:g}"
            )


def _make_revolute(joint: ElementTree.Element) -> None:
    joint.set("type", "revolute")
    limit = joint.find("limit")
    if limit is None:
        limit = ElementTree.SubElement(joint, "limit", effort="1e9", velocity="1e9")
    limit.set("lower", repr(-np.pi))
    limit.set("upper", repr(np.pi))


def build(urdf: Path, text: str) -> pin.Model:
    """Pinocchio's model of a URDF, given as text.

    Raises:
        GymMaraError: Pinocchio cannot load it.
    """
    with named_in_errors(urdf):
        return pin.buildModelFromXML(text)


@contextmanager
def named_in_errors(urdf: Path) -> Iterator[None]:
    """Raise Pinocchio's errors as GymMaraError, with the name of the file."""
    try:
        yield
    except GymMaraError:
        raise
    except (OSError, ValueError, RuntimeError) as error:
        # Coal's errors begin with lines about its own source code.
        reason = " ".join(str(error).rpartition("message:")[2].split())
        raise GymMaraError(f"Pinocchio cannot load the URDF {str(urdf)!r}: {reason}") from error
