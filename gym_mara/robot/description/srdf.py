"""SRDF, ROS's format for what a URDF does not hold: disabled collisions, named poses, the end effector.

Pinocchio reads which pairs of links are disabled; the rest is read here:

- Named poses. Pinocchio's `loadReferenceConfigurations` sorts the poses by name, sets the joints that a pose does not name
  to zero, and takes a value that it cannot read for zero. Then it is lost which pose comes first, and which names every
  joint of the arm.
- The end effector's link, which Pinocchio does not read.
- The names of links and joints, to check them: Pinocchio ignores those that the URDF lacks.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError
from gym_mara.robot.description.xml_files import read_xml


class Pose(NamedTuple):
    """A named pose of a group of joints."""

    name: str
    """Poses of different groups may have the same."""
    values: dict[str, tuple[float, ...]]
    """Joint name to position, rad (m for a prismatic joint); a joint of several degrees of freedom has several."""


@dataclass(frozen=True)
class Semantics:
    """What gym_mara reads of an SRDF file."""

    xml: str = "<robot/>"
    """The SRDF itself."""
    disabled_links: frozenset[str] = frozenset()
    """The links of the pairs that are never checked for collision."""
    poses: tuple[Pose, ...] = ()
    """In the file's order."""
    end_effector: str | None = None
    """The parent link of the first end effector."""

    def home(self, joints: Sequence[str]) -> list[float]:
        """The positions, rad, in the first pose that names every one of these joints; zeros if there is none.

        Raises:
            GymMaraError: the pose gives one of the joints several values, or none.
        """
        pose, values = self.home_pose(joints)
        for joint in joints:
            if len(values.get(joint, (0.0,))) != 1:
                raise GymMaraError(
                    f"the SRDF's pose {pose!r} gives joint {joint!r} {len(values[joint])} values; "
                    "a revolute or prismatic joint has one"
                )
        return [values.get(joint, (0.0,))[0] for joint in joints]

    def home_pose(self, joints: Sequence[str]) -> Pose:
        """The first pose that names every one of these joints; without values if there is none."""
        fitting = (pose for pose in self.poses if all(joint in pose.values for joint in joints))
        return next(fitting, Pose("", {}))

    def unknown_names(self, root: ElementTree.Element) -> list[str]:
        """The links and joints that are named here and that a URDF lacks, in alphabetical order."""
        links = {link.get("name") for link in root.findall("link")}
        joints = {joint.get("name") for joint in root.findall("joint")}
        named = {joint for pose in self.poses for joint in pose.values}
        return sorted((self.disabled_links - links) | (named - joints))

    def remove_disabled_pairs(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        """Remove the disabled pairs of links from a geometry's collision pairs."""
        pin.removeCollisionPairsFromXML(model, geometry, self.xml)


def read_srdf(path: Path) -> Semantics:
    """Read an SRDF file.

    Raises:
        GymMaraError: the file is missing or is not an SRDF, a name is missing, or a value is not a number.
    """
    root = read_xml(path, "SRDF")
    poses = tuple(
        Pose(
            _attribute(path, state, "name"),
            {_attribute(path, j, "name"): _position(path, j) for j in state.iter("joint")},
        )
        for state in root.iter("group_state")
    )
    effector = next(root.iter("end_effector"), None)
    return Semantics(
        ElementTree.tostring(root, encoding="unicode"),
        frozenset(
            _attribute(path, pair, end)
            for pair in root.iter("disable_collisions")
            for end in ("link1", "link2")
        ),
        poses,
        None if effector is None else _attribute(path, effector, "parent_link"),
    )


def _attribute(path: Path, element: ElementTree.Element, name: str) -> str:
    value = element.get(name)
    if value is None:
        raise GymMaraError(
            f"the SRDF {str(path)!r} has a <{element.tag}> without {name!r}: "
            f"{ElementTree.tostring(element, encoding='unicode').split('>')[0].strip()}>"
        )
    return value


def _position(path: Path, joint: ElementTree.Element) -> tuple[float, ...]:
    value = _attribute(path, joint, "value")
    try:
        position = tuple(float(part) for part in value.split())
    except ValueError:
        position = (np.nan,)
    if not np.isfinite(position).all():
        raise GymMaraError(
            f"the SRDF {str(path)!r} puts joint {joint.get('name')!r} at {value!r}; "
            "a joint's value must be a finite number, rad (m for a prismatic joint)"
        )
    return position
