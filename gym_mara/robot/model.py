"""RobotModel: everything the package knows of an arm, read once from its URDF and SRDF."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError, finite_numbers
from gym_mara.robot import catalog
from gym_mara.robot.bounds import Bounds
from gym_mara.robot.catalog import RobotFiles
from gym_mara.robot.collision_pairs import Pair, link_of
from gym_mara.robot.description.off_chain import Follower
from gym_mara.robot.description.shapes import Shape
from gym_mara.robot.description.target import Target
from gym_mara.robot.diagnosis import Finding, raise_errors, warn
from gym_mara.robot.geometry import Geometry, read_geometry
from gym_mara.robot.kinematics import Kinematics, motion_axis
from gym_mara.robot.loading import from_files, from_modules, read_only, with_notes
from gym_mara.robot.options import RobotOptions, is_path
from gym_mara.types import Floats


@dataclass(frozen=True, eq=False)
class RobotModel:
    """A fixed-base arm: the chain of joints from the world to the end-effector frame, with all links attached to it.

    Joints off the chain (a gripper's fingers) are locked. Arrays are read-only, (J,), in the order of the chain.
    """

    name: str
    """The robot's name, as `load` takes it or as the URDF has it."""
    urdf: Path
    """The file that the arm was read from; MARA's for an arm composed of modules."""
    srdf: Path | None
    """The SRDF that was read; None if there is none."""
    modules: tuple[str, ...]
    """The modules that the arm was composed of, from the base to the tool; empty otherwise."""
    xml: str
    """The URDF as text, with all joints off the chain fixed."""
    ee_frame: str
    """The end-effector link."""
    joint_names: tuple[str, ...]
    """The joints of the chain, from the base to the end effector."""
    followers: tuple[Follower, ...]
    """The joints off the chain that mimic one of it; in `model` they come after the chain, in this order."""
    lower: Floats
    """Lower position limits, rad (m for a prismatic joint)."""
    upper: Floats
    """Upper position limits, rad (m for a prismatic joint)."""
    velocity_limit: Floats
    """Velocity limits, rad/s (m/s)."""
    effort_limit: Floats
    """Effort limits, Nm (N)."""
    home: Floats
    """The start pose, rad (m): the SRDF's first pose that names every joint, or zeros, within the limits by whole turns, or else clipped."""
    collision_pairs: frozenset[Pair]
    """The pairs of links that may collide."""
    excluded_pairs: Mapping[Pair, str]
    """The other pairs of links on different bodies, and why they are never checked."""
    target: Target | None
    """The default target, from the file NAME.target.json beside NAME.urdf; None if there is no such file."""
    model: pin.Model
    """Pinocchio's model, its joints those of `joint_names`."""
    geometry: pin.GeometryModel
    """Pinocchio's collision geometry, with its collision pairs set."""
    shapes: tuple[Shape, ...]
    """The collision shapes, those of `geometry.geometryObjects`."""
    options: RobotOptions
    """What was added to the files."""
    findings: tuple[Finding, ...]
    """What is wrong with the files."""
    without: tuple[str, ...] = ()
    """The links of the URDF that were left out, such as the table of "mara_no_table"."""
    _unwarned: bool = field(default=False, init=False)
    """Whether the warnings for backends with dynamics are still to come."""

    @classmethod
    def load(
        cls, robot: RobotLike | Path, ee_frame: str | None = None, **options: Any
    ) -> RobotModel:
        """Load a robot by its name ("mara", "ur5", …), the path of its URDF, or a list of modules.

        A RobotModel is returned as it is. Warns of what is probably not meant, see `findings`.

        Args:
            robot: the robot. A path ends in ".urdf" or ".xml", or has a folder ("./arm"); NAME.srdf and NAME.target.json
                beside NAME.urdf are read too.
            ee_frame: the end-effector link; by default the catalogue's, or the one that the SRDF names.
            **options: fields of `RobotOptions`.

        Raises:
            GymMaraError: the name is unknown, or the URDF does not describe a fixed-base arm.
            MissingExtraError: the robot's files come with a package that is not installed.
        """
        loaded = cls.inspect(robot, ee_frame, **options)
        return loaded if loaded is robot else loaded._checked()

    @classmethod
    def inspect(
        cls, robot: RobotLike | Path, ee_frame: str | None = None, **options: Any
    ) -> RobotModel:
        """Load a robot as `load` does, but do not warn of its findings.

        Raises:
            GymMaraError: the robot cannot be read at all.
            MissingExtraError: the robot's files come with a package that is not installed.
        """
        if ee_frame is not None and not isinstance(ee_frame, str):
            raise GymMaraError(f"ee_frame must be the name of a link, not {ee_frame!r}")
        if isinstance(robot, RobotModel):
            if ee_frame is not None or options:
                given = ", ".join([*(["ee_frame"] if ee_frame is not None else []), *options])
                raise GymMaraError(
                    f"{given} cannot change a RobotModel; give it to RobotModel.load, which made the model"
                )
            return robot
        own = RobotOptions(**options)
        if isinstance(robot, (list, tuple)):
            return from_modules(cls, robot, own)
        if not isinstance(robot, (str, Path)):
            raise GymMaraError(
                f"robot must be a name, the path of a URDF, a list of modules or a RobotModel, not {robot!r}"
            )
        if isinstance(robot, Path) or is_path(robot):
            path = Path(robot).absolute()
            srdf = path.with_suffix(".srdf")
            srdf_there = srdf if srdf.is_file() else None
            return from_files(cls, RobotFiles(path, srdf_there, ee_frame), None, own)
        if robot not in catalog.robot_names() and robot and os.path.lexists(robot):
            raise GymMaraError(
                f"robot={robot!r} is no robot's name; for the file of that name write {os.path.join('.', robot)!r}"
            )
        files = catalog.find(robot)
        files = files._replace(ee_frame=ee_frame or files.ee_frame)
        return with_notes(from_files(cls, files, robot, own))

    @classmethod
    def from_urdf(
        cls,
        urdf: Path | str,
        ee_frame: str | None = None,
        srdf: Path | str | None = None,
        *,
        name: str | None = None,
        **options: Any,
    ) -> RobotModel:
        """Load an arm from your own files.

        Meshes are looked for in `package_dirs`, beside the URDF, in the folders above it, and along ROS_PACKAGE_PATH and
        AMENT_PREFIX_PATH. Links joined by one joint never collide. Links that touch at home do not collide either, unless an SRDF disables
        pairs of links.

        Args:
            urdf: path of the URDF file.
            ee_frame: the end-effector link; by default the one that the SRDF names.
            srdf: path of the SRDF file: disabled collisions, home pose, end effector. None for none: unlike `load`, this does not
                read the one beside the URDF.
            name: the robot's name; by default the one in the URDF.
            **options: fields of `RobotOptions`.

        Raises:
            GymMaraError: a file is missing or broken, the frame does not exist, or no fixed-base chain leads to it.

        Warns of what is probably not meant, see `findings`.
        """
        own = RobotOptions(**options)
        files = RobotFiles(Path(urdf), Path(srdf) if srdf else None, ee_frame)
        return from_files(cls, files, name, own)._checked()

    @classmethod
    def from_modules(cls, modules: Sequence[str], **options: Any) -> RobotModel:
        """Compose an arm of 3 to 7 joints from MARA's modules, on MARA's table.

        Args:
            modules: from "base" to "tool"; between them "motor_large", "motor_medium", "motor_small", "link_straight" and
                "link_bent", in any number and order in which their faces fit. A motor makes a joint at each of its faces.
            **options: fields of `RobotOptions`.

        Raises:
            GymMaraError: a module is unknown or does not fit, or the arm has too few or too many joints.
        """
        return from_modules(cls, modules, RobotOptions(**options))

    def _checked(self) -> RobotModel:
        """This robot; warns of its findings, in the name of the caller of the calling method."""
        warn(repr(str(self.urdf)), self.findings, dynamics=False, stacklevel=3)
        object.__setattr__(self, "_unwarned", True)
        return self

    @property
    def num_joints(self) -> int:
        """J, the number of joints of the chain."""
        return len(self.joint_names)

    @property
    def ee_frame_id(self) -> int:
        """Pinocchio's index of the end-effector frame."""
        # The type is given because a joint may have the same name.
        return int(self.model.getFrameId(self.ee_frame, pin.FrameType.BODY))

    @cached_property
    def visual(self) -> Geometry:
        """The visual shapes, read on first use; the collision shapes if the URDF has no others."""
        visual = read_geometry(self.urdf, self.xml, self.model, "visual", self.options.package_dirs)
        return visual if visual.shapes else Geometry(self.geometry, self.shapes)

    def require_dynamics(self) -> None:
        """Check that backends with dynamics can simulate this arm, and warn once of what is probably not meant.

        Raises:
            GymMaraError: they cannot; it says why, and what to do.
        """
        raise_errors(self.name, self.findings)
        if self._unwarned:
            object.__setattr__(self, "_unwarned", False)
            warn(repr(str(self.urdf)), self.findings, dynamics=True, stacklevel=2)

    def motion(self, number: int) -> Floats:
        """The motion subspace (6,) of a joint of `model`, in its own frame: linear part, then angular.

        Args:
            number: Pinocchio's index of the joint, from 1.
        """
        motion = motion_axis(self.model.joints[number])
        if number > self.num_joints:  # Pinocchio gives it per unit of the leader
            motion = motion / self.followers[number - 1 - self.num_joints].multiplier
        return motion

    def kinematics(self) -> Kinematics:
        """The forward kinematics, a new instance for each caller."""
        return Kinematics(self.model, self.ee_frame_id)

    @cached_property
    def reach(self) -> Floats:
        """A bound (J,) on how far any point of the arm moves per unit that a joint moves: m/rad, or 1 if prismatic."""
        return read_only(self.bounds.reach)

    @property
    def extent(self) -> float:
        """A bound on how far any point of the arm can be from the world's origin, m."""
        return self.bounds.extent

    @cached_property
    def bounds(self) -> Bounds:
        """How far the joints move the arm's points."""
        return Bounds.of(self.model, self.geometry, self.ee_frame_id, self.followers)

    def link_of(self, geometry_index: int) -> str:
        """The name of the link that a collision shape belongs to, given the shape's index."""
        return link_of(self.model, self.geometry.geometryObjects[geometry_index])

    def checked_q(self, q: Sequence[float] | Floats, what: str) -> Floats:
        """A configuration (J,) checked to be within this robot's limits, as a new array.

        Args:
            q: the configuration, rad.
            what: what it is, for the error.

        Raises:
            GymMaraError: it has the wrong length, is not finite or is beyond a joint's limits.
        """
        array = np.array(finite_numbers(what, q))
        if array.shape != (self.num_joints,):
            raise GymMaraError(
                f"{what} has shape {array.shape}; {self.name} needs {(self.num_joints,)}"
            )
        beyond = ~((array >= self.lower) & (array <= self.upper))
        if beyond.any():
            joint = int(beyond.argmax())
            raise GymMaraError(
                f"{what}: joint {self.joint_names[joint]} cannot be at {array[joint]}; "
                f"its limits are [{self.lower[joint]}, {self.upper[joint]}]"
            )
        return array

    def __reduce__(self) -> tuple[Any, ...]:
        # Pinocchio's geometry does not pickle; a copy is loaded from the modules or the files.
        if self.modules:
            return from_modules, (RobotModel, self.modules, self.options, self.findings)
        files = RobotFiles(self.urdf, self.srdf, self.ee_frame, self.without)
        arguments = RobotModel, files, self.name, self.options, self.findings
        return from_files, arguments, {"_unwarned": self._unwarned}

    def __deepcopy__(self, memo: dict[int, Any]) -> RobotModel:
        return self  # immutable

    def __repr__(self) -> str:
        return f"RobotModel({self.name!r}, joints={list(self.joint_names)}, ee_frame={self.ee_frame!r})"


RobotLike = str | Sequence[str] | RobotModel
"""A robot's name, the path of its URDF, a list of modules, or a loaded robot."""
