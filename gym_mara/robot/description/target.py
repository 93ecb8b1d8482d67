"""NAME.target.json beside NAME.urdf: the robot's default target."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from gym_mara.errors import GymMaraError
from gym_mara.files import MissingFileError, read_json


@dataclass(frozen=True)
class Target:
    """A pose of the end-effector frame in the world.

    Raises:
        GymMaraError: the quaternion is no unit quaternion.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid", "allow_inf_nan": False}

    position: tuple[float, float, float]
    """m."""
    quaternion: tuple[float, float, float, float]
    """[w, x, y, z]."""

    def __post_init__(self) -> None:
        if abs(math.hypot(*self.quaternion) - 1.0) > 1e-3:
            raise GymMaraError(
                f"'quaternion' must be a unit quaternion [w, x, y, z], not {self.quaternion}"
            )


def read_target(urdf: Path) -> Target | None:
    """The default target of the robot of a URDF; None if there is no such file beside it.

    Raises:
        DamagedFileError: the file has another form.
    """
    try:
        return read_json(urdf.with_suffix(".target.json"), Target, largest=2**16)
    except MissingFileError:
        return None
