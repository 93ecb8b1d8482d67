"""Arms composed of MARA's modules: a base, motors of three sizes, two links, a tool.

A module is a link of MARA's URDF with the two faces that join it to its neighbours. There is a joint at a face if the module
on at least one side of it is a motor; otherwise the two modules are fixed to each other.
"""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gym_mara.errors import GymMaraError, unknown
from gym_mara.robot.description.xml_files import read_xml
from gym_mara.types import Floats

FEWEST_JOINTS, MOST_JOINTS = 3, 7
MOST_MODULES = 50
EE_FRAME = "ee_link"


class Face(NamedTuple):
    """Where a module is joined to another: MARA's joint there, and the direction of the face's normal."""

    joint: str
    normal: str
    """A signed axis of the module's frame, such as "+z"."""


class Module(NamedTuple):
    """A link of MARA with its inner face, towards the base, and its outer face, towards the tool."""

    link: str
    inner: Face | None
    outer: Face | None
    motor: bool = False
    upside_down: bool = False

    def reversed(self) -> Module:
        """The module mounted the other way round; turned upside down, so that the arm still points up at home."""
        return self._replace(inner=self.outer, outer=self.inner, upside_down=True)


MODULES = {
    "base": Module("base_robot", None, Face("motor1", "+z")),
    "motor_large": Module("motor1_link", Face("motor1", "-z"), Face("motor2", "+x"), motor=True),
    "link_straight": Module("motor2_link", Face("motor2", "-x"), Face("motor3", "-x")),
    "motor_medium": Module("motor3_link", Face("motor3", "+x"), Face("motor4", "+z"), motor=True),
    "link_bent": Module("motor4_link", Face("motor4", "-z"), Face("motor5", "-x")),
    "motor_small": Module("motor5_link", Face("motor5", "+x"), Face("motor6", "+z"), motor=True),
    "tool": Module("motor6_link", Face("motor6", "-z"), None),
}
MARA = tuple(MODULES)
"""MARA itself, from its base to its tool."""


def compose(mara: Path, names: Sequence[str]) -> ElementTree.Element:
    """The URDF of an arm made of modules, on MARA's table.

    Args:
        mara: path of MARA's URDF.
        names: the modules from the base to the tool, keys of `MODULES`.

    Raises:
        GymMaraError: a name is unknown, two faces do not fit, or the arm has too few or too many joints or modules.
    """
    if len(names) > MOST_MODULES:
        raise GymMaraError(
            f"an arm must have at most {MOST_MODULES} modules, which is more than {MOST_JOINTS} joints need; not {len(names)}"
        )
    modules = _oriented(names)
    source = read_xml(mara, "URDF")
    links = {link.get("name"): link for link in source.iter("link")}
    joints = {joint.get("name"): joint for joint in source.iter("joint")}
    arm = _scene(source)
    base, *others = modules
    inner, before, name_before, turning = np.zeros(3), base, base.link, 0
    for number, module in enumerate(others, start=1):
        assert before.outer is not None
        assert module.inner is not None
        driver = before.outer if before.motor else module.inner
        turns = before.motor or module.motor
        turning += turns
        name = f"motor{turning}_link" if turns else f"module{number}_link"
        # Each link's frame lies at its inner face. The own frame of a reversed module does not, so it is moved.
        origin = _place(joints, before, before.outer) - inner
        inner = _place(joints, module, module.inner)
        link = _moved(links[module.link], -inner)
        link.set("name", name)
        joint = ElementTree.Element("joint", type="fixed", name=f"joint_of_{name}")
        if turns:
            joint.attrib = {"type": "revolute", "name": f"motor{turning}"}
            of_mara = joints[driver.joint]
            joint.extend(copy.deepcopy(part) for part in of_mara if part.tag in ("axis", "limit"))
        ElementTree.SubElement(joint, "parent", link=name_before)
        ElementTree.SubElement(joint, "child", link=name)
        ElementTree.SubElement(joint, "origin", xyz=_text(origin), rpy=_turn(before, module))
        arm.extend((link, joint))
        before, name_before = module, name
    if not FEWEST_JOINTS <= turning <= MOST_JOINTS:
        raise GymMaraError(
            f"an arm must have {FEWEST_JOINTS} to {MOST_JOINTS} joints, and {', '.join(names)} makes {turning}; "
            "a motor makes a joint at each of its two faces"
        )
    tool = next(j for j in source.iter("joint") if _end(j, "child") == EE_FRAME)
    tool = copy.deepcopy(tool)
    tool.find("parent").set("link", name_before)  # type: ignore[union-attr]
    arm.extend((copy.deepcopy(links[EE_FRAME]), tool))
    return arm


def _oriented(names: Sequence[str]) -> list[Module]:
    """The modules, each reversed if only then it fits the one before."""
    for name in names:
        if name not in MODULES:
            raise unknown("module", name, MODULES)
    ends = [name for name in names if name in ("base", "tool")]
    if ends != ["base", "tool"] or names[0] != "base" or names[-1] != "tool":
        raise GymMaraError(
            f"an arm must begin with its only 'base' and end with its only 'tool'; this is: {', '.join(names)}"
        )
    modules = [MODULES["base"]]
    for number, name in enumerate(names[1:], start=1):
        module, outer = MODULES[name], modules[-1].outer
        assert outer is not None
        ways = [module] if name == "tool" else [module, module.reversed()]
        fitting = [way for way in ways if way.inner and way.inner.normal[1] == outer.normal[1]]
        if not fitting:
            raise GymMaraError(
                f"{name!r} does not fit onto {names[number - 1]!r}: {_fits(outer)}; "
                "a motor has one face at its end (z) and one at its side (x)"
            )
        modules.append(fitting[0])
    return modules


def _fits(outer: Face) -> str:
    axis = outer.normal[1]
    fitting = [
        name
        for name, module in MODULES.items()
        if name != "base" and axis in {f.normal[1] for f in (module.inner, module.outer) if f}
    ]
    return f"what fits onto its face along {axis}: {', '.join(fitting)}"


def _scene(source: ElementTree.Element) -> ElementTree.Element:
    """MARA's URDF without its arm: colours, the table, the base."""
    moving = [module.link for module in MODULES.values() if module.inner] + [EE_FRAME]
    scene = ElementTree.Element("robot", name="modular")
    for element in source:
        of_arm = element.get("name") if element.tag == "link" else _end(element, "child")
        if of_arm not in moving:
            scene.append(copy.deepcopy(element))
    return scene


def _end(joint: ElementTree.Element, which: str) -> str | None:
    end = joint.find(which)
    return None if end is None else end.get("link")


def _place(joints: dict[str | None, ElementTree.Element], module: Module, face: Face) -> Floats:
    """A face's position in the module's own frame (3,), m; in MARA that frame lies at the face towards the base."""
    joint = joints[face.joint]
    return _vector(joint.find("origin")) if _end(joint, "parent") == module.link else np.zeros(3)


def _turn(before: Module, module: Module) -> str:
    """A module's rotation on the one before, as roll, pitch, yaw: face to face, and with its outer end up."""
    outer, inner = before.outer, module.inner
    assert outer is not None
    assert inner is not None
    roll = math.pi if before.upside_down != module.upside_down else 0.0
    yaw = math.pi if outer.normal == inner.normal and inner.normal[1] == "x" else 0.0
    return f"{roll!r} 0.0 {yaw!r}"


def _moved(link: ElementTree.Element, by: Floats) -> ElementTree.Element:
    """A copy of a link with its inertia and shapes moved by a vector (3,), m."""
    link = copy.deepcopy(link)
    for part in link:
        origin = part.find("origin")
        if origin is not None:
            origin.set("xyz", _text(_vector(origin) + by))
    return link


def _vector(origin: ElementTree.Element | None) -> Floats:
    return np.array(
        [float(x) for x in (origin.get("xyz", "0 0 0") if origin is not None else "0 0 0").split()]
    )


def _text(vector: Floats) -> str:
    return " ".join(repr(float(x)) for x in vector)
