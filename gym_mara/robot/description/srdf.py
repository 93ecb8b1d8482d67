"""SRDF, ROS's format for what a URDF does not hold: disabled collisions, named poses, the end effector.

Pinocchio reads a part of it. All is read here:

- Disabled pairs of links. Pinocchio ignores `disable_default_collisions`, MoveIt's short form for a link that collides with none
  but those that `enable_collisions` names.
- Named poses. Pinocchio's `loadReferenceConfigurations` sorts the poses by name, sets the joints that a pose does not name
  to zero, and takes a value that it cannot read for zero. Then it is lost which pose comes first, and which names every
  joint of the arm.
- The end effector's link, which Pinocchio does not read.
- The names of links and joints, to check them: Pinocchio ignores those that the URDF lacks.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

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

    disabled: frozenset[frozenset[str]] = frozenset()
    """The pairs of links that are never checked for collision."""
    enabled: frozenset[frozenset[str]] = frozenset()
    """The pairs that are checked although a link of theirs is in `disabled_links`."""
    disabled_links: frozenset[str] = frozenset()
    """The links of which no other pair is checked."""
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

    def without(self, links: frozenset[str]) -> Semantics:
        """The same without the pairs that name one of these links."""
        return replace(
            self,
            disabled=frozenset(pair for pair in self.disabled if not pair & links),
            enabled=frozenset(pair for pair in self.enabled if not pair & links),
            disabled_links=self.disabled_links - links,
        )

    @property
    def names(self) -> frozenset[str]:
        """The links of pairs and the joints of poses that are named here."""
        joints = (pose.values for pose in self.poses)
        return self.disabled_links.union(*self.disabled, *self.enabled, *joints)

    def unknown_names(self, root: ElementTree.Element) -> list[str]:
        """The names here that neither a link nor a joint of a URDF has, in alphabetical order."""
        return sorted(self.names - {e.get("name") for e in root if e.tag in ("link", "joint")})

    def disables(self, pair: frozenset[str]) -> bool:
        """Whether a pair of links is never checked for collision."""
        return pair in self.disabled or (
            pair not in self.enabled and bool(pair & self.disabled_links)
        )

    def disables_any(self, root: ElementTree.Element) -> bool:
        """Whether pairs of links of a URDF are disabled."""
        links = {link.get("name", "") for link in root.findall("link")}
        return bool(self.disabled_links & links) or any(pair <= links for pair in self.disabled)


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
    defaults = root.iter("disable_default_collisions")
    return Semantics(
        disabled=_pairs(path, root, "disable_collisions"),
        enabled=_pairs(path, root, "enable_collisions"),
        disabled_links=frozenset(_attribute(path, element, "link") for element in defaults),
        poses=poses,
        end_effector=None if effector is None else _attribute(path, effector, "parent_link"),
    )


def _pairs(path: Path, root: ElementTree.Element, tag: str) -> frozenset[frozenset[str]]:
    """The pairs of links in the elements of this name."""
    return frozenset(
        frozenset(_attribute(path, element, end) for end in ("link1", "link2"))
        for element in root.iter(tag)
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
