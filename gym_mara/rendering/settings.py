"""The settings of pictures and of the viewer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from gym_mara.errors import GymMaraError, one_of, unknown, whole_number

RENDERERS = ("vtk", "raycast")
"""In the order of preference."""
# The direction from the middle of the scene to each camera: azimuth and elevation, deg.
CAMERAS = {
    "three_quarter": (208.0, 20.0),
    "front": (180.0, 6.0),
    "side": (270.0, 6.0),
    "top": (180.0, 89.0),
}
_HIGHEST = {"width": 4096, "height": 4096, "viewer_port": 65535}


@dataclass(frozen=True)
class RenderSettings:
    """The settings of pictures and of the viewer; each is a keyword argument of the environments.

    Raises:
        GymMaraError: a value has the wrong form or is out of its range.
    """

    width: int = 640
    """The width of a picture, pixels."""
    height: int = 480
    """The height of a picture, pixels."""
    camera: str | tuple[tuple[float, ...], tuple[float, ...]] = "three_quarter"
    """The name of a camera, or its position and the point that it looks at, each [x, y, z], m, in the world frame."""
    renderer: str | None = None
    """"vtk" or "raycast"; None for the first one that works on this machine."""
    viewer_host: str = "127.0.0.1"
    """The address that the viewer listens on."""
    viewer_port: int = 8080
    """The port that the viewer listens on; if it is in use, the next free port."""

    def __post_init__(self) -> None:
        for name, highest in _HIGHEST.items():
            port = name == "viewer_port"
            reason = "ports end there" if port else "larger pictures take too much memory and time"
            value = whole_number(name, getattr(self, name), at_most=highest, reason=reason)
            object.__setattr__(self, name, value)
        if self.renderer is not None:
            one_of("renderer", self.renderer, RENDERERS)
        if not isinstance(self.viewer_host, str):
            raise GymMaraError(f"viewer_host must be an address as text, not {self.viewer_host!r}")
        if not isinstance(self.camera, str):
            object.__setattr__(self, "camera", _two_points(self.camera))
        elif self.camera not in CAMERAS:
            raise unknown("camera", self.camera, CAMERAS)


def _two_points(camera: Sequence[Sequence[float]]) -> tuple[tuple[float, ...], ...]:
    try:
        points = np.asarray(camera, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        points = np.empty(0)
    if points.shape != (2, 3) or not np.isfinite(points).all() or (points[0] == points[1]).all():
        raise GymMaraError(
            f"camera must be one of {', '.join(CAMERAS)}, or two points [[x, y, z], [x, y, z]], m: "
            f"its position and the point that it looks at; not {camera!r}"
        )
    return tuple(map(tuple, points.tolist()))
