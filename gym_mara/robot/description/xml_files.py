"""Reads the XML of URDF and SRDF files, and recognises xacro that was not expanded."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

from gym_mara.errors import GymMaraError, short
from gym_mara.files import LARGEST_TEXT, read_bytes

_DEEPEST = 100
"""Of the elements of a URDF or SRDF: the parsers that read it later are recursive."""
_OF_OTHERS = ("gazebo", "transmission", "ros2_control")
"""Elements for other programs."""
_DEFINED = ("property", "arg")
"""Elements of xacro that only define values: where no value is used, nothing is to be expanded."""


def read_xml(path: Path, kind: str) -> ElementTree.Element:
    """The root of an XML file whose root element is `<robot>`.

    Args:
        path: the file.
        kind: "URDF" or "SRDF", for errors.

    Raises:
        GymMaraError: the file is missing, is not XML, describes no robot, or is xacro that must be expanded first.
    """
    if os.path.isdir(path):
        raise GymMaraError(f"cannot read {str(path)!r}: it is a folder; {_urdfs_in(path)}")
    content = read_bytes(path, LARGEST_TEXT)
    try:
        root = ElementTree.fromstring(content)
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # the last two: its encoding
        if "unbound prefix" in str(error) and b"<xacro:" in content:
            raise _not_expanded(path, kind, "it has elements <xacro:…>") from None
        line = _line_of(error, content)
        raise GymMaraError(f"the {kind} {str(path)!r} is broken XML: {error}{line}") from error
    if _depth(root) > _DEEPEST:
        raise GymMaraError(
            f"the {kind} {str(path)!r} has elements nested more than {_DEEPEST} deep; a robot has fewer than 10"
        )
    if root.tag != "robot":
        raise GymMaraError(f"{str(path)!r} is not a {kind}: its root is <{root.tag}>, not <robot>")
    if residue := _xacro_in(root):
        raise _not_expanded(path, kind, residue)
    return root


def remove_links(root: ElementTree.Element, links: Sequence[str]) -> frozenset[str]:
    """Remove links from a URDF, each with the joint that carries it; returns their names."""
    for element in [*root]:
        child = element.find("child")
        carried = element.get("name") if child is None else child.get("link")
        if element.tag in ("link", "joint") and carried in links:
            root.remove(element)
    return frozenset(links)


def _line_of(error: Exception, content: bytes) -> str:
    """The line of a file where the parser stopped, for an error; empty if it has no text."""
    number, _ = getattr(error, "position", (0, 0))
    line = content.splitlines()[number - 1 : number]
    text = line[0].decode(errors="replace").strip() if line else ""
    return f": {short(text)}" if text else ""


def _urdfs_in(folder: Path) -> str:
    """The URDFs in a folder, for an error."""
    names = sorted(file.name for file in folder.iterdir() if file.suffix.lower() == ".urdf")
    return f"name one of its URDFs: {', '.join(names[:10])}" if names else "name the URDF itself"


def _xacro_in(root: ElementTree.Element) -> str:
    """What shows that a file was not expanded by xacro; empty if nothing does."""
    for part in root:
        if part.tag in _OF_OTHERS:
            continue
        for element in part.iter():
            tag = str(element.tag)
            own = re.match(r"\{[^}]*xacro[^}]*\}(.*)", tag)
            if own and own[1] not in _DEFINED:
                return f"it has an element <xacro:{own[1]}>"
            for name, value in element.items():
                if "${" in value or "$(" in value:
                    return f"<{tag}> has {name}={short(value)}"
    return ""


def _not_expanded(path: Path, kind: str, why: str) -> GymMaraError:
    expanded = path.name.removesuffix(".xacro").rpartition(".")[0] or path.stem
    return GymMaraError(
        f"the {kind} {str(path)!r} is xacro, a template: {why}; "
        f"expand it first: xacro {path.name} > {expanded}_expanded.{kind.lower()}"
    )


def _depth(root: ElementTree.Element) -> int:
    """How deep the elements are nested; at most one more than allowed."""
    level, depth = [root], 0
    while level and depth <= _DEEPEST:
        level, depth = [child for element in level for child in element], depth + 1
    return depth
