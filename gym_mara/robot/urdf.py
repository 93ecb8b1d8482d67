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
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError


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
    while link in joints:
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
            chain.insert(0, joint.get("name", ""))
    if not chain:
        raise GymMaraError(
            f"{str(urdf)!r}: no moving joint leads to {ee_frame!r}; name a link that the arm moves"
        )
    for joint, _ in joints.values():
        joint.set("type", "fixed")
    return chain


def _make_revolute(joint: ElementTree.Element) -> None:
    joint.set("type", "revolute")
    limit = joint.find("limit")
    if limit is None:
        limit = ElementTree.SubElement(joint, "limit", effort="1e9", velocity="1e9")
    limit.set("lower", repr(-np.pi))
    limit.set("upper", repr(np.pi))


def build(urdf: Path, text: str) -> tuple[pin.Model, pin.GeometryModel]:
    """Pinocchio's model and collision geometry of a URDF, given as text.

    Raises:
        GymMaraError: Pinocchio cannot load it, or a mesh is not found.
    """
    with _named_in_errors(urdf):
        model = pin.buildModelFromXML(text)
        return model, _geometry(urdf, model, text, pin.GeometryType.COLLISION)


def visual_geometry(urdf: Path, text: str, model: pin.Model) -> pin.GeometryModel:
    """The visual geometry of a model's links; their collision geometry if the URDF has no visual geometry.

    Raises:
        GymMaraError: a mesh is not found.
    """
    with _named_in_errors(urdf):
        geometry = _geometry(urdf, model, text, pin.GeometryType.VISUAL)
        if geometry.ngeoms == 0:
            geometry = _geometry(urdf, model, text, pin.GeometryType.COLLISION)
        return geometry


def _geometry(urdf: Path, model: pin.Model, text: str, kind: pin.GeometryType) -> pin.GeometryModel:
    # Meshes are often named package://…; the package may be any folder above the URDF.
    ros_path = [folder for folder in os.environ.get("ROS_PACKAGE_PATH", "").split(":") if folder]
    folders = [str(parent) for parent in urdf.absolute().parents] + ros_path
    return pin.buildGeomFromUrdfString(model, text, kind, package_dirs=folders)


@contextmanager
def _named_in_errors(urdf: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, RuntimeError) as error:
        raise GymMaraError(f"Pinocchio cannot load the URDF {str(urdf)!r}: {error}") from error
