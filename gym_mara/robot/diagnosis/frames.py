"""Which links of a URDF can be the end-effector frame."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from typing import NamedTuple

_TOOL = re.compile(r"tool|tcp|end_?eff|(^|_)eef?(_|$)|grasp|grip|hand", re.IGNORECASE)
"""In names of frames that are made for the tool."""
_FINGER = re.compile(r"finger|jaw|claw|knuckle", re.IGNORECASE)
"""In names of a gripper's moving parts."""


class Frame(NamedTuple):
    """A link that joints move."""

    link: str
    """Its name."""
    joints: int
    """The number of moving joints between the base and it."""
    last: bool
    """Whether no other link is attached to it."""


def candidate_frames(root: ElementTree.Element) -> list[Frame]:
    """The links of a URDF that two joints or more move, at least half as many as move any link: the best one first.

    The best one is a link with a name that is usual for tools, which the most joints move; a finger is not taken.
    """
    parents: dict[str, tuple[str, bool]] = {}
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None:
            moves = joint.get("type") != "fixed" and joint.find("mimic") is None
            parents[child.get("link", "")] = parent.get("link", ""), moves
    branches = [parent for parent, _ in parents.values()]
    frames = []
    for link in parents:
        joints = sum(parents[each][1] for each in _path(link, parents))
        frames.append(Frame(link, joints, link not in branches))
    most = max((frame.joints for frame in frames), default=0)
    frames = [frame for frame in frames if frame.joints and 2 * frame.joints >= most]
    palm = _palm([frame.link for frame in frames if frame.joints == most], parents)

    def rank(frame: Frame) -> tuple[bool, bool, bool, int, bool]:
        named = bool(_TOOL.search(frame.link)) and frame.joints >= most - 1
        body = not _FINGER.search(frame.link)
        return body, named, frame.link == palm, frame.joints, frame.last

    return sorted(frames, key=rank, reverse=True)


def _path(link: str, parents: dict[str, tuple[str, bool]]) -> list[str]:
    """A link and those that carry it, without the root."""
    path: list[str] = []
    while link in parents and link not in path:
        path.append(link)
        link = parents[link][0]
    return path


def _palm(links: list[str], parents: dict[str, tuple[str, bool]]) -> str | None:
    """The last link that carries all of these: the palm of their fingers."""
    paths = [_path(link, parents) for link in links]
    if not paths:
        return None
    shared = set(paths[0]).intersection(*paths[1:])
    return next((link for link in paths[0] if link in shared), None)
