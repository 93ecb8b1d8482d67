"""Reads a URDF as one chain of joints and builds Pinocchio's model of it.

Joints off the chain are locked, or follow a joint of the chain that they mimic. They are locked by making them fixed in the
URDF's XML, not by Pinocchio's `buildReducedModel`, which was tried on every robot of the catalogue. It fails where a locked
joint and a link have the same name (so100's gripper) and rejects locked joints without limits. Elsewhere it makes the same
model, but sums inertias in another order, so that they differ in the last bits. And the XML must be changed anyway: Pinocchio
stores the angle of a continuous joint as its cosine and sine.
"""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

import pinocchio as pin

from gym_mara.errors import GymMaraError
from gym_mara.robot.description.joints import axis_of, limits_of, link_at
from gym_mara.robot.description.off_chain import Follower
from gym_mara.robot.description.parser import parsing
from gym_mara.robot.diagnosis import Finding

_MOST_IN_CHAIN = 100
_IN_CHAIN = ("revolute", "continuous", "prismatic", "fixed")


def ee_frame_among_links(urdf: Path, root: ElementTree.Element, ee_frame: str | None) -> str:
    """The name of the end-effector frame, checked to be one of the URDF's links.

    Raises:
        GymMaraError: the URDF has no link of that name, or no name is given.
    """
    links = [link.get("name", "") for link in root.findall("link")]
    if ee_frame is None:
        raise GymMaraError(
            f"name the end-effector link of {str(urdf)!r} (ee_frame=…), one of: {', '.join(links)}"
        )
    if ee_frame not in links:
        raise GymMaraError(
            f"{str(urdf)!r} has no link {ee_frame!r} for the end-effector frame; it has: {', '.join(links)}"
        )
    return ee_frame


def find_chain(urdf: Path, root: ElementTree.Element, ee_frame: str) -> tuple[str, ...]:
    """The names of the moving joints that lead to the end-effector frame, in a URDF that `check_urdf` accepts.

    Raises:
        GymMaraError: none leads there, or one of them is of an unsupported type, mimics another, or has no range or direction.
    """
    joint_to = {link_at(joint, "child"): joint for joint in root.findall("joint")}
    chain: list[str] = []
    link = ee_frame
    while link in joint_to:
        joint = joint_to[link]
        link = link_at(joint, "parent")
        kind, name = joint.get("type"), joint.get("name", "")
        if kind not in _IN_CHAIN:
            raise GymMaraError(
                f"{str(urdf)!r} is not a fixed-base chain to {ee_frame!r}: joint {name!r} is {kind}; "
                "only revolute, continuous, prismatic and fixed joints may lead there"
            )
        if kind == "fixed":
            continue
        if (mimic := joint.find("mimic")) is not None:
            raise GymMaraError(
                f"{str(urdf)!r}: joint {name!r}, which leads to {ee_frame!r}, mimics {mimic.get('joint')!r}; only joints off "
                f"the chain may. Remove its <mimic> if a motor drives it, or name another end-effector link"
            )
        _check_motion(urdf, joint)
        chain.insert(0, name)
    if not chain:
        raise GymMaraError(
            f"{str(urdf)!r}: no moving joint leads to {ee_frame!r}; name a link that the arm moves"
        )
    if len(chain) > _MOST_IN_CHAIN:
        raise GymMaraError(
            f"{str(urdf)!r}: {len(chain)} joints lead to {ee_frame!r}; at most {_MOST_IN_CHAIN} are allowed"
        )
    return tuple(chain)


def _check_motion(urdf: Path, joint: ElementTree.Element) -> None:
    """Raises GymMaraError if a joint has no direction, or its limits are incomplete or in the wrong order."""
    name, limit = f"joint {joint.get('name')!r}", joint.find("limit")
    axis_of(urdf, joint)
    if limit is None and joint.get("type") == "continuous":
        return
    if limit is None:
        raise GymMaraError(
            f"{str(urdf)!r}: {name} is {joint.get('type')} and has no <limit>; it needs one"
        )
    missing = [name for name in ("effort", "velocity") if name not in limit.attrib]
    if missing:
        raise GymMaraError(f"{str(urdf)!r}: the <limit> of {name} lacks {' and '.join(missing)}")
    limits_of(urdf, joint)


def build(
    urdf: Path, root: ElementTree.Element, chain: Sequence[str], followers: Sequence[Follower]
) -> tuple[pin.Model, list[Finding]]:
    """Pinocchio's model of a URDF, whose first joints are the chain, and what the parser warns of.

    Raises:
        GymMaraError: Pinocchio cannot load it.
    """
    names: dict[str, str] = {}
    if followers:
        root, names = _chain_first(root, chain)
    text = ElementTree.tostring(root, encoding="unicode")
    with parsing(urdf) as written:
        model = (
            pin.buildModelFromXML(text, mimic=True) if followers else pin.buildModelFromXML(text)
        )
    for number in range(1, model.njoints if names else 0):
        model.names[number] = names[model.names[number]]
    for frame in model.frames[1:] if names else ():
        if frame.type != pin.FrameType.BODY:
            frame.name = names[frame.name]
    findings = [
        Finding("warning", "URDF", line, "the parser ignores it", "Correct it") for line in written
    ]
    return model, findings


def _chain_first(
    root: ElementTree.Element, chain: Sequence[str]
) -> tuple[ElementTree.Element, dict[str, str]]:
    """A copy of a URDF with other names for the joints, and the true name of each.

    The parser sorts the joints of a link by name. With the new names it meets the chain first, because Pinocchio wants a joint
    before those that mimic it.
    """
    root = copy.deepcopy(root)
    joints = root.findall("joint")
    joint_to = {link_at(joint, "child"): joint for joint in joints}
    way = set()
    link = next(link_at(joint, "child") for joint in joints if joint.get("name") == chain[-1])
    while link in joint_to:
        way.add(joint_to[link])
        link = link_at(joint_to[link], "parent")
    names = {}
    for number, joint in enumerate(sorted(joints, key=lambda joint: joint not in way)):
        names[f"{number:04}"] = joint.get("name", "")
        joint.set("name", f"{number:04}")
    numbers = {name: number for number, name in names.items()}
    for mimic in root.iterfind("joint/mimic"):
        mimic.set("joint", numbers[mimic.get("joint", "")])
    return root, names
