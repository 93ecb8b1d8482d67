"""Makes a RobotModel: reads its files or modules, adds what the user gives, and looks for what is wrong."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from gym_mara.robot import catalog
from gym_mara.robot.collision_pairs import set_collision_pairs
from gym_mara.robot.description.checks import check_urdf
from gym_mara.robot.description.empty_shapes import drop_empty_shapes
from gym_mara.robot.description.joints import within_limits
from gym_mara.robot.description.modules import EE_FRAME, MARA, compose
from gym_mara.robot.description.off_chain import keep_chain
from gym_mara.robot.description.srdf import Semantics, read_srdf
from gym_mara.robot.description.target import Target, read_target
from gym_mara.robot.description.urdf import build, ee_frame_among_links, find_chain
from gym_mara.robot.description.xml_files import read_xml, remove_links
from gym_mara.robot.diagnosis import (
    Finding,
    body_findings,
    collision_findings,
    joint_findings,
    range_findings,
    semantics_findings,
    written_joints,
)
from gym_mara.robot.geometry import read_geometry
from gym_mara.robot.inertia import add_inertias
from gym_mara.robot.kinematics import motion_axis
from gym_mara.robot.options import RobotOptions
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot.model import RobotModel

Findings = Sequence[Finding]


def from_files(
    cls: type[RobotModel],
    files: catalog.RobotFiles,
    name: str | None,
    options: RobotOptions,
    findings: Findings | None = None,
) -> RobotModel:
    """The arm of a URDF and an SRDF.

    Args:
        cls: RobotModel.
        files: what it is read from.
        name: the robot's name; None for the URDF's.
        options: what is added to the files.
        findings: those of an arm of which a copy is made; None to look for them.

    Raises:
        GymMaraError: a file is missing or broken, or describes no fixed-base arm.
    """
    urdf, srdf, ee_frame, without = files
    root = read_xml(urdf, "URDF")
    of_files = check_urdf(urdf, root, options.package_dirs)
    semantics = read_srdf(srdf) if srdf else Semantics()
    semantics = semantics.without(remove_links(root, without))
    ee_frame = ee_frame_among_links(urdf, root, ee_frame or semantics.end_effector)
    target = read_target(urdf)
    robot = _build(cls, root, semantics, ee_frame, name, urdf, srdf, (), target, options)
    of_files += semantics_findings(robot, semantics, root)
    return _with_findings(replace(robot, without=without), findings, of_files)


def from_modules(
    cls: type[RobotModel],
    modules: Sequence[str],
    options: RobotOptions,
    findings: Findings | None = None,
) -> RobotModel:
    """The arm of MARA's modules; see `from_files` for the other arguments.

    Raises:
        GymMaraError: a module is unknown or does not fit, or the arm has too few or too many joints.
    """
    urdf = catalog.find("mara").urdf
    root = compose(urdf, modules)
    name, target = ("mara", read_target(urdf)) if tuple(modules) == MARA else (None, None)
    robot = _build(
        cls, root, Semantics(), EE_FRAME, name, urdf, None, tuple(modules), target, options
    )
    return with_notes(_with_findings(robot, findings))


def _build(
    cls: type[RobotModel],
    root: ElementTree.Element,
    semantics: Semantics,
    ee_frame: str,
    name: str | None,
    urdf: Path,
    srdf: Path | None,
    modules: tuple[str, ...],
    target: Target | None,
    options: RobotOptions,
) -> RobotModel:
    """The arm of a URDF that has been read, without findings."""
    empty = drop_empty_shapes(root)
    chain = find_chain(urdf, root, ee_frame)
    written = written_joints(root)
    followers = keep_chain(urdf, root, chain, semantics.home_pose(chain).values)
    model, of_parser = build(urdf, root, chain, followers)
    xml = ElementTree.tostring(root, encoding="unicode")
    geometry, shapes = read_geometry(
        urdf, xml, model, "collision", options.package_dirs, convex_hulls=options.convex_hulls
    )
    options.apply_limits(model, chain)
    if options.default_mass is not None:
        add_inertias(model, geometry, shapes, options.default_mass)
    home = _home(semantics.home(chain), model)
    pairs = set_collision_pairs(root, semantics, model, geometry, home)
    return cls(
        name=name or root.get("name") or urdf.stem,
        urdf=urdf,
        srdf=srdf,
        modules=modules,
        xml=xml,
        ee_frame=ee_frame,
        joint_names=chain,
        followers=tuple(sorted(followers, key=lambda follower: model.getJointId(follower.name))),
        lower=read_only(model.lowerPositionLimit),
        upper=read_only(model.upperPositionLimit),
        velocity_limit=read_only(model.velocityLimit),
        effort_limit=read_only(model.effortLimit),
        home=read_only(home),
        collision_pairs=pairs.checked,
        excluded_pairs=MappingProxyType(pairs.excluded),
        target=target,
        model=model,
        geometry=geometry,
        shapes=shapes,
        options=options,
        findings=(*empty, *of_parser, *range_findings(written, chain, followers, model)),
    )


def _home(pose: Sequence[float], model: pin.Model) -> Floats:
    """A pose of the chain (J,), rad (m), within the limits of Pinocchio's model."""
    limits = model.lowerPositionLimit.tolist(), model.upperPositionLimit.tolist()
    turns = (bool(motion_axis(joint)[3:].any()) for joint in model.joints[1:])
    joints = zip(pose, *limits, turns, strict=False)  # those that follow come last
    return np.array([within_limits(at, low, high, turns=turn) for at, low, high, turn in joints])


def _with_findings(
    robot: RobotModel, findings: Findings | None, of_files: Findings = ()
) -> RobotModel:
    """The arm with these findings, or else with those of its files and its own."""
    if findings is None:
        own = [*joint_findings(robot), *body_findings(robot), *collision_findings(robot)]
        findings = [*of_files, *robot.findings, *own]
    return replace(robot, findings=tuple(findings))


def with_notes(robot: RobotModel) -> RobotModel:
    """The arm with notes in place of warnings: its files are not the user's own."""
    notes = [replace(f, severity="note") if f.severity == "warning" else f for f in robot.findings]
    return replace(robot, findings=tuple(notes))


def read_only(values: Floats) -> Floats:
    """A copy that cannot be changed."""
    array = np.array(values, dtype=np.float64)
    array.flags.writeable = False
    return array
