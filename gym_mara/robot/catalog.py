"""The robots known by name, and their files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import pinocchio

from gym_mara.errors import MissingExtraError, unknown
from gym_mara.files import read_text


class RobotFiles(NamedTuple):
    """What a robot is read from."""

    urdf: Path
    srdf: Path | None = None
    """None if the robot has none."""
    ee_frame: str | None = None
    """The end-effector frame; None for the one that the SRDF names."""
    without: tuple[str, ...] = ()
    """The links of the URDF that are left out, each with the joint that carries it; nothing may be attached to them."""


def _robots_dir() -> Path:
    """Inside the package where it is installed, and beside it in a checkout, also if another one is installed."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "robots"
    return installed if installed.is_dir() else package.parent / "robots"


def own_robots() -> dict[str, RobotFiles]:
    """The robots that gym_mara ships: one folder NAME each, with NAME.urdf and NAME.srdf."""
    return {
        urdf.stem: RobotFiles(urdf, urdf.with_suffix(".srdf"))
        for urdf in sorted(_robots_dir().glob("*/*.urdf"))
        if urdf.stem == urdf.parent.name
    }


def _variants() -> dict[str, RobotFiles]:
    """The robots that are one of gym_mara's own without some of its links."""
    listed: dict[str, dict[str, Any]] = json.loads(read_text(_robots_dir() / "variants.json"))
    own = own_robots()
    return {
        name: own[entry["of"]]._replace(without=tuple(entry["without"]))
        for name, entry in listed.items()
    }


def example_robots_dir() -> Path | None:
    """The folder of example-robot-data's robots, or None if it is not installed."""
    for parent in Path(pinocchio.__file__).resolve().parents:
        folder = parent / "share" / "example-robot-data" / "robots"
        if folder.is_dir():
            return folder
    return None


def _example_arms() -> dict[str, dict[str, str | None]]:
    """The fixed-base arms of example-robot-data by name, their files relative to its folder of robots."""
    arms: dict[str, dict[str, str | None]] = json.loads(
        read_text(_robots_dir() / "example_arms.json")
    )
    return arms


def robot_names() -> list[str]:
    """Every name that `find` accepts; the robots that gym_mara ships come first."""
    return [*own_robots(), *_variants(), *_example_arms()]


def find(name: str) -> RobotFiles:
    """The files of the robot of this name.

    Raises:
        GymMaraError: no robot has this name.
        MissingExtraError: the robot comes with example-robot-data, which is not installed.
    """
    own = own_robots() | _variants()
    if name in own:
        return own[name]
    arm = _example_arms().get(name)
    if arm is None:
        raise unknown("robot", name, robot_names())
    folder = example_robots_dir()
    if folder is None:
        raise MissingExtraError(f"robot {name!r}", "example-robot-data", "robots")
    srdf = arm["srdf"]
    return RobotFiles(folder / str(arm["urdf"]), folder / srdf if srdf else None, arm["ee_frame"])
