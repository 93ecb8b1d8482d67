"""The keyword arguments that describe a robot, and the paths among them."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import fields
from typing import Any

from gym_mara.robot.model import is_path
from gym_mara.robot.options import RobotOptions

ROBOT_KEYWORDS = ("robot", "ee_frame", *(field.name for field in fields(RobotOptions)))


def with_paths(options: dict[str, Any], moved: Callable[[str], str]) -> dict[str, Any]:
    """Keyword arguments in which `moved` replaces each relative path: of the robot, and of its `package_dirs`."""

    def replaced(path: Any) -> Any:
        return path if not isinstance(path, str) or os.path.isabs(path) else moved(path)

    changed = dict(options)
    if is_path(robot := options.get("robot")):
        changed["robot"] = replaced(os.fspath(robot))
    if isinstance(
        folders := options.get("package_dirs"), (list, tuple)
    ):  # others are refused later
        changed["package_dirs"] = [replaced(folder) for folder in folders]
    return changed
