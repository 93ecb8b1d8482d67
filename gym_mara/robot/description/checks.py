"""Checks a URDF's XML before Pinocchio reads it.

Pinocchio reads URDFs with urdfdom. It drops elements that it cannot read, so that a link loses its mass or its collisions, and
ignores elements and attributes that it does not know. So the structure is checked here: what is broken is an error with the
name of the link or joint, and what is only ignored is a finding.
"""

from __future__ import annotations

import difflib
import os
import re
import xml.etree.ElementTree as ElementTree
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from gym_mara.errors import GymMaraError, short
from gym_mara.files import plain_size
from gym_mara.robot.description.joints import link_at
from gym_mara.robot.description.meshes.files import LARGEST_MESHES, candidates, folder_findings
from gym_mara.robot.diagnosis import Finding, Severity

# More than any robot has; the number of pairs of shapes grows with the square.
_MOST = {"link": 1000, "joint": 1000, "collision": 500}
_LARGEST_NUMBER = 1e12
"""Of a URDF: the products of larger ones may overflow."""
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)
"""As C++ reads them: Python's float accepts more."""
_LEAST_INERTIA = -1e-9
"""A principal moment of inertia may be negative by rounding, as a part of the largest."""
JOINT_TYPES = ("revolute", "continuous", "prismatic", "fixed", "floating", "planar")
_NAMED = ("link", "joint", "parent", "child", "mimic")
"""Elements whose names may not be empty; some programs leave those of materials empty."""
_SHAPES = ("box", "sphere", "cylinder", "capsule", "mesh")


class _Element(NamedTuple):
    """What urdfdom expects of an element."""

    parents: tuple[str, ...]
    needed: tuple[str, ...] = ()
    """Attributes that it must have."""
    numbers: Mapping[str, float] = MappingProxyType({})
    """Attributes that hold numbers → the least value."""
    children: tuple[str, ...] = ()
    """Elements that it must hold."""
    texts: tuple[str, ...] = ()
    """Other attributes."""
    repeats: bool = False
    """Whether its parent may hold several."""


_ANY, _POSITIVE = -_LARGEST_NUMBER, 0.0
_MOMENTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
_ROUND = {"radius": _POSITIVE, "length": _POSITIVE}
_ELEMENTS = {
    "link": _Element(("robot",), ("name",), repeats=True),
    "joint": _Element(("robot",), ("name", "type"), children=("parent", "child"), repeats=True),
    "inertial": _Element(("link",), children=("mass", "inertia")),
    "visual": _Element(("link",), children=("geometry",), texts=("name",), repeats=True),
    "collision": _Element(("link",), children=("geometry",), texts=("name",), repeats=True),
    "origin": _Element(
        ("inertial", "visual", "collision", "joint"), numbers={"xyz": _ANY, "rpy": _ANY}
    ),
    "mass": _Element(("inertial",), ("value",), {"value": _POSITIVE}),
    "inertia": _Element(("inertial",), _MOMENTS, dict.fromkeys(_MOMENTS, _ANY)),
    "geometry": _Element(("visual", "collision")),
    "box": _Element(("geometry",), ("size",), {"size": _POSITIVE}),
    "sphere": _Element(("geometry",), ("radius",), {"radius": _POSITIVE}),
    "cylinder": _Element(("geometry",), tuple(_ROUND), _ROUND),
    "capsule": _Element(("geometry",), tuple(_ROUND), _ROUND),
    "mesh": _Element(("geometry",), ("filename",), {"scale": _ANY}),
    "parent": _Element(("joint",), ("link",)),
    "child": _Element(("joint",), ("link",)),
    "axis": _Element(("joint",), ("xyz",), {"xyz": _ANY}),
    "limit": _Element(
        ("joint",),
        numbers={"lower": _ANY, "upper": _ANY, "effort": _POSITIVE, "velocity": _POSITIVE},
    ),
    "dynamics": _Element(("joint",), numbers={"damping": _POSITIVE, "friction": _POSITIVE}),
    "mimic": _Element(("joint",), ("joint",), {"multiplier": _ANY, "offset": _ANY}),
    "material": _Element(("robot", "visual", "collision"), ("name",)),
    "color": _Element(("material",), ("rgba",), {"rgba": _POSITIVE}),
    "texture": _Element(("material",), ("filename",)),
}
_COUNT = {"xyz": 3, "rpy": 3, "size": 3, "scale": 3, "rgba": 4}
"""How many numbers an attribute has; the others have one."""


def check_urdf(
    urdf: Path,
    root: ElementTree.Element,
    package_dirs: Sequence[str] = (),
    severity: Severity = "warning",
) -> list[Finding]:
    """Check a URDF: how much it holds, its elements, its numbers, its tree of links, and its mesh files.

    Spaces between numbers are made single, and a robot without a name gets that of its file, because urdfdom reads no others.

    Args:
        urdf: the file.
        root: its XML.
        package_dirs: folders in which packages are looked for, too.
        severity: of the findings.

    Returns:
        What the parser would silently ignore.

    Raises:
        GymMaraError: there are too many links or shapes, an element lacks a part, a number is not finite or out of range, the
            links are not one tree, or a mesh is not a plain file or too large.
    """
    for tag, most in _MOST.items():
        found = sum(1 for _ in root.iter(tag))
        if found > most:
            raise GymMaraError(
                f"{str(urdf)!r} has {found:,} elements <{tag}>; at most {most:,} are allowed"
            )
    findings: list[Finding] = []
    if not root.get("name"):
        root.set("name", urdf.stem)
        findings.append(
            Finding(
                "note",
                "<robot>",
                "it has no name",
                f"it is called {urdf.stem!r}; other programs refuse the file",
                'Write <robot name="…">',
            )
        )
    try:
        for part in root:
            ignored = list(_odd(root, part))
            if part.tag in ("link", "joint", "material"):
                ignored += _check_part(part)
            findings += [
                Finding(severity, _name(part), what, "it is ignored", remedy)
                for what, remedy in ignored
            ]
        _check_tree(root)
    except _BadPartError as error:
        raise GymMaraError(f"{str(urdf)!r}: {error}") from None
    names = {mesh.get("filename", "") for mesh in root.iter("mesh")} - {""}
    places = (place for name in names for place in candidates(urdf, name, package_dirs))
    if sum(plain_size(place) for place in places if os.path.lexists(place)) > LARGEST_MESHES:
        raise GymMaraError(
            f"the meshes of {str(urdf)!r} are larger than {LARGEST_MESHES:,} bytes together"
        )
    return [*findings, *folder_findings(urdf, sorted(names), package_dirs)]


class _BadPartError(Exception):
    """What is wrong with a link or joint, without the name of the file."""


def _name(part: ElementTree.Element) -> str:
    return f"<{part.tag}>" if part.get("name") is None else f"{part.tag} {part.get('name')!r}"


def _check_part(part: ElementTree.Element) -> Iterator[tuple[str, str]]:
    """Check a link, joint or material with all that it holds; yield what is ignored, and what to do.

    Raises:
        _BadPartError: an element is broken.
    """
    waiting = [part]
    while waiting:
        element = waiting.pop()
        _check_element(part, element)
        counts = Counter(child.tag for child in element)
        for child in element:
            odd = list(_odd(element, child))
            yield from odd
            if child.tag in _ELEMENTS and not odd:
                waiting.append(child)
        for tag, count in counts.items():
            if count > 1 and tag in _ELEMENTS and not _ELEMENTS[tag].repeats:
                yield (
                    f"<{element.tag}> has {count} elements <{tag}>, of which only the first counts",
                    "Keep one",
                )
        yield from _odd_attributes(element)


def _check_element(part: ElementTree.Element, element: ElementTree.Element) -> None:
    """Raises _BadPartError if an element lacks a part, or a number is bad."""
    tag, expected = element.tag, _ELEMENTS[element.tag]
    of_part = f"<{tag}> of {_name(part)}" if element is not part else _name(part)
    for name in expected.needed:
        if element.get(name) is None or (tag in _NAMED and not element.get(name)):
            raise _BadPartError(f'{of_part} has no {name}; write <{tag} {name}="…">')
    for child in expected.children:
        if element.find(child) is None:
            raise _BadPartError(f"{of_part} has no <{child}>; it needs one")
    for name, least in expected.numbers.items():
        text = element.get(name)
        if text is not None:
            if not _is_number(text, name, least):
                raise _BadPartError(
                    f"{of_part} has {name}={short(text)}; {_COUNT.get(name, 1)} finite number(s) "
                    f"from {least:g} to {_LARGEST_NUMBER:g} are allowed"
                )
            element.set(name, " ".join(text.split()))
    if tag == "joint" and element.get("type") not in JOINT_TYPES:
        raise _BadPartError(
            f"{of_part} has type={short(element.get('type'))}; allowed are {', '.join(JOINT_TYPES)}"
        )
    if tag == "geometry" and (len(element) != 1 or element[0].tag not in _SHAPES):
        held = ", ".join(f"<{child.tag}>" for child in element) or "nothing"
        raise _BadPartError(f"{of_part} holds {held}; it must hold one of {', '.join(_SHAPES)}")
    if tag == "inertia":
        xx, xy, xz, yy, yz, zz = (float(element.get(name, "")) for name in _MOMENTS)
        least, _, most = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]).tolist()
        if least < _LEAST_INERTIA * max(most, -least):
            raise _BadPartError(
                f"{of_part} has the principal moment {least:g} kg·m²; a body's moments of inertia are not negative"
            )


def _is_number(text: str, name: str, least: float) -> bool:
    """Whether the value of an attribute has as many numbers as it must have, from `least` to the largest allowed."""
    parts = text.split()
    return len(parts) == _COUNT.get(name, 1) and all(
        _NUMBER.fullmatch(part) and least <= float(part) <= _LARGEST_NUMBER for part in parts
    )


def _odd(parent: ElementTree.Element, child: ElementTree.Element) -> Iterator[tuple[str, str]]:
    """An element that is ignored because of its place, or because its name is almost one of URDF's; and what to do."""
    tag = str(child.tag)
    if tag in _ELEMENTS:
        if parent.tag not in (parents := _ELEMENTS[tag].parents):
            places = " or ".join(f"<{place}>" for place in parents)
            yield f"<{tag}> stands in <{parent.tag}>", f"Move it into {places}"
    elif similar := _similar(tag, _ELEMENTS):
        yield f"URDF has no element <{tag}>", f"Probably <{similar}> is meant"


def _odd_attributes(element: ElementTree.Element) -> Iterator[tuple[str, str]]:
    """The attributes that are ignored, although their names are almost those of URDF, and text in place of one."""
    known = [*_ELEMENTS[element.tag].needed, *_ELEMENTS[element.tag].numbers]
    known += _ELEMENTS[element.tag].texts
    for name in element.attrib:
        if name not in known and (similar := _similar(name, known)):
            yield f"<{element.tag}> has no attribute {name!r}", f"Probably {similar!r} is meant"
    text = (element.text or "").strip()
    if text and _ELEMENTS[element.tag].numbers:
        yield f"<{element.tag}> holds the text {short(text)}", "Write it as an attribute"


def _similar(name: str, known: Iterable[str]) -> str | None:
    """The known name that is probably meant, if a name differs from it by its case or a letter."""
    return next(iter(difflib.get_close_matches(name.lower(), list(known), 1, 0.85)), None)


def _check_tree(root: ElementTree.Element) -> None:
    """Raises _BadPartError unless names are unique, and the joints connect all links to one tree."""
    for tag in ("link", "joint", "material"):
        counts = Counter(part.get("name") for part in root.findall(tag))
        if repeated := [name for name, count in counts.items() if count > 1]:
            raise _BadPartError(
                f"{counts[repeated[0]]} elements <{tag}> have the name {repeated[0]!r}"
            )
    links = {link.get("name") for link in root.findall("link")}
    joint_to: dict[str, ElementTree.Element] = {}
    parent_of: dict[str, str] = {}
    for joint in root.findall("joint"):
        parent, child = link_at(joint, "parent"), link_at(joint, "child")
        for end, link in (("parent", parent), ("child", child)):
            if link not in links:
                raise _BadPartError(f"the {end} of {_name(joint)} is {link!r}, which is no link")
        if child in joint_to:
            raise _BadPartError(
                f"link {child!r} is the child of {_name(joint_to[child])} and of {_name(joint)}; the links must form a tree"
            )
        joint_to[child], parent_of[child] = joint, parent
    connected = set(links) - parent_of.keys()
    if len(connected) > 1:
        raise _BadPartError(
            f"{len(connected)} links are the child of no joint: {', '.join(sorted(map(str, connected))[:10])}; "
            "only the base may be. Attach the others with fixed joints, or remove them"
        )
    for link in parent_of:
        way: list[str] = []
        while link not in connected:
            if link in way:
                raise _BadPartError(
                    f"the joints form a loop at {link!r}: the links must form a tree"
                )
            way.append(link)
            link = parent_of[link]
        connected.update(way)
