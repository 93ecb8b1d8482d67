"""The keyword arguments that describe a robot: which one, where its packages are, and values that replace those of its files."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import pinocchio as pin

from gym_mara.errors import GymMaraError, flag, positive_number, unknown
from gym_mara.types import Floats

PerJoint = float | Sequence[float] | Mapping[str, float]
"""A number for every joint, one for each joint of the chain, or numbers by the names of joints."""


@dataclass(frozen=True)
class RobotOptions:
    """How a robot's files are read, and what replaces their values. Each value is a keyword argument of the environments.

    Raises:
        GymMaraError: a value has the wrong form or is out of its range.
    """

    package_dirs: Sequence[str] = ()
    """Folders in which the packages of package://… are looked for first."""
    default_mass: float | None = None
    """The mass of each moving body that has none, kg; its inertia is that of its shapes. None leaves it without mass."""
    effort_limit: PerJoint | None = None
    """Nm (N for a prismatic joint), in place of the URDF's; None for those."""
    velocity_limit: PerJoint | None = None
    """rad/s (m/s), in place of the URDF's; None for those."""
    convex_hulls: bool = False
    """Whether the convex hull of each collision mesh takes its place: faster, but it fills hollows."""

    def __post_init__(self) -> None:
        folders = self.package_dirs
        if isinstance(folders, str) or not all(isinstance(folder, str) for folder in folders):
            raise GymMaraError(f"package_dirs must be a list of folders, not {folders!r}")
        object.__setattr__(self, "package_dirs", tuple(folders))
        if self.default_mass is not None:
            mass = positive_number("default_mass", self.default_mass, "kg", at_least=1e-6)
            object.__setattr__(self, "default_mass", mass)
        object.__setattr__(self, "convex_hulls", flag("convex_hulls", self.convex_hulls))
        for name in ("effort_limit", "velocity_limit"):
            object.__setattr__(self, name, _per_joint(name, getattr(self, name)))

    def apply_limits(self, model: pin.Model, joints: Sequence[str]) -> None:
        """Put `effort_limit` and `velocity_limit` in place of those of Pinocchio's model.

        Args:
            model: the model.
            joints: the names of the joints of the chain.

        Raises:
            GymMaraError: a name is no joint of the chain, or there are too few or too many values.
        """
        if self.effort_limit is not None:
            model.effortLimit = self._limits("effort_limit", joints, model.effortLimit)
        if self.velocity_limit is not None:
            model.velocityLimit = self._limits("velocity_limit", joints, model.velocityLimit)

    def _limits(self, name: str, joints: Sequence[str], of_urdf: Floats) -> Floats:
        """The limits (J,) of these joints that `effort_limit` or `velocity_limit` gives, else those of the URDF."""
        given, limits = getattr(self, name), np.array(of_urdf, dtype=np.float64)
        if isinstance(given, dict):
            for joint, value in given.items():
                if joint not in joints:
                    raise unknown("joint", joint, joints, f" in {name}")
                limits[joints.index(joint)] = value
        elif isinstance(given, tuple) and len(given) != len(joints):
            raise GymMaraError(
                f"{name} has {len(given)} values; the arm has {len(joints)} joints: {', '.join(joints)}"
            )
        else:
            limits[:] = given
        return limits


def _per_joint(name: str, given: Any) -> PerJoint | None:
    """A number, a tuple of numbers or a dictionary of numbers, checked to be positive.

    Raises:
        GymMaraError: it is neither, or a number is not positive.
    """
    if isinstance(given, Mapping):
        return {joint: positive_number(f"{name}[{joint!r}]", v) for joint, v in given.items()}
    if isinstance(given, (Sequence, np.ndarray)) and not isinstance(given, str) and np.ndim(given):
        return tuple(positive_number(name, value) for value in given)
    return None if given is None else positive_number(name, given)


ROBOT_KEYWORDS = ("robot", "ee_frame", *(field.name for field in fields(RobotOptions)))
"""Those that name the robot, and its options."""


def is_path(robot: object) -> TypeGuard[str | Path]:
    """Whether a robot is given by the path of its URDF."""
    if isinstance(robot, str):
        name = robot.lower()
        return name.endswith((".urdf", ".xml", ".xacro")) or os.sep in name or "/" in name
    return isinstance(robot, Path)


def with_paths(options: dict[str, Any], moved: Callable[[str], str]) -> dict[str, Any]:
    """Keyword arguments in which `moved` replaces each relative path: of the robot, and of its `package_dirs`."""

    def replaced(path: Any) -> Any:
        return path if not isinstance(path, str) or os.path.isabs(path) else moved(path)

    changed = dict(options)
    if is_path(robot := options.get("robot")):
        changed["robot"] = replaced(os.fspath(robot))
    folders = options.get("package_dirs")
    if isinstance(folders, (list, tuple)):  # others are refused later
        changed["package_dirs"] = [replaced(folder) for folder in folders]
    return changed
