"""SRDF, ROS' format for what a URDF leaves unsaid: which links may collide, named poses, the end effector."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from dataclasses import dataclass, field
from pathlib import Path

from gym_mara.errors import GymMaraError


@dataclass(frozen=True)
class Semantics:
    """What gym_mara reads of an SRDF file."""

    disabled_pairs: frozenset[frozenset[str]] = frozenset()
    """Pairs of link names that are never checked for collision."""
    group_states: tuple[dict[str, float], ...] = field(default=())
    """Named poses, joint name to position (rad), in the file's order."""
    end_effector: str | None = None
    """The link that the first end effector hangs on."""


def read_srdf(path: Path) -> Semantics:
    """Read an SRDF file.

    Raises:
        GymMaraError: the file is missing or is not an SRDF.
    """
    root = read_xml(path, "SRDF")
    states = []
    for state in root.iter("group_state"):
        # A joint of several degrees of freedom lists several values: not an arm's, and no part of its pose.
        values = {j.attrib["name"]: j.attrib["value"].split() for j in state.iter("joint")}
        states.append({name: float(v[0]) for name, v in values.items() if len(v) == 1})
    effector = next(root.iter("end_effector"), None)
    return Semantics(
        frozenset(
            frozenset((d.attrib["link1"], d.attrib["link2"]))
            for d in root.iter("disable_collisions")
        ),
        tuple(states),
        None if effector is None else effector.get("parent_link"),
    )


def read_xml(path: Path, kind: str) -> ElementTree.Element:
    """The root of an XML file with a `<robot>` at its top.

    Raises:
        GymMaraError: the file is missing, is not XML, or describes no robot.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except OSError as error:
        raise GymMaraError(f"cannot read the {kind} {str(path)!r}: {error.strerror}") from error
    except (ElementTree.ParseError, UnicodeDecodeError) as error:
        raise GymMaraError(f"the {kind} {str(path)!r} is broken XML: {error}") from error
    if root.tag != "robot":
        raise GymMaraError(f"{str(path)!r} is no {kind}: its root is <{root.tag}>, not <robot>")
    return root
