"""The settings of pictures, of the viewer, and of pictures as observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from gym_mara.errors import GymMaraError, one_of, short, unknown, whole_number

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

CHANNELS = ("rgb", "depth", "segmentation")
STATE, PIXELS, JOINTS = "state", "pixels", "joints+pixels"
OBSERVATIONS = (STATE, PIXELS, "state+pixels", JOINTS)
"""What is observed; the first two are keys of an observation, too."""
TOOL = "tool"
"""The name of the camera on the tool."""
RANDOM = ("light", "colour", "camera")
"""What can be random."""


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


@dataclass(frozen=True)
class PixelSettings:
    """Whether observations have pictures, and of what; each setting is a keyword argument of the environments.

    Raises:
        GymMaraError: a value has the wrong form or is out of its range, or has no effect.
    """

    observation: str = STATE
    """"state", "pixels", "state+pixels", or "joints+pixels": of the state only what a robot knows of itself, its joints and tool."""
    pixel_size: int | tuple[int, int] = 84
    """The height and width of a picture, pixels; one number for both."""
    pixel_camera: str | tuple[tuple[float, ...], tuple[float, ...]] = "three_quarter"
    """"tool", the name of a camera of the scene, or its position and the point that it looks at, as `camera`."""
    pixel_channels: tuple[str, ...] = ("rgb",)
    """Some of "rgb", "depth" and "segmentation"."""
    pixel_randomisation: Mapping[str, float] | None = None
    """How much the "light", the "colour" of parts and the "camera" differ in each episode; None for not at all."""

    @property
    def sides(self) -> tuple[int, int]:
        """The height and width of a picture, pixels."""
        size = self.pixel_size
        return size if isinstance(size, tuple) else (size, size)

    def __post_init__(self) -> None:
        one_of("observation", self.observation, OBSERVATIONS)
        if self.observation == STATE:
            for field in fields(self)[1:]:
                default: Any = field.default
                if not np.array_equal(getattr(self, field.name), default):
                    raise GymMaraError(
                        f"{field.name} has no effect without pictures: give observation='state+pixels', 'joints+pixels' "
                        "or 'pixels'"
                    )
            return
        size = self.pixel_size
        pair = tuple(size) if isinstance(size, (tuple, list, np.ndarray)) else (size, size)
        if len(pair) != 2:
            raise GymMaraError(
                f"pixel_size must be one number, or a height and a width, not {short(size)}"
            )
        reason = "larger pictures take too much memory and time"
        sides = tuple(
            whole_number("pixel_size", side, at_most=1024, reason=reason) for side in pair
        )
        object.__setattr__(self, "pixel_size", sides)
        if not isinstance(self.pixel_camera, str) or self.pixel_camera != TOOL:
            camera = _checked_camera(self.pixel_camera)
            object.__setattr__(self, "pixel_camera", camera)
        channels = self.pixel_channels
        if not isinstance(channels, (tuple, list)) or not channels:
            raise GymMaraError(
                f"pixel_channels must be a list of some of {', '.join(CHANNELS)}, not {short(channels)}"
            )
        for channel in channels:
            one_of("pixel_channels", channel, CHANNELS)
        if len(set(channels)) < len(channels):
            raise GymMaraError(f"pixel_channels must name each channel once, not {short(channels)}")
        object.__setattr__(self, "pixel_channels", tuple(channels))
        random = _checked_randomisation(self.pixel_randomisation)
        object.__setattr__(self, "pixel_randomisation", random)


def _checked_camera(camera: Any) -> Any:
    try:
        return RenderSettings(camera=camera).camera
    except GymMaraError as error:
        if isinstance(camera, str):
            raise unknown("pixel_camera", camera, [TOOL, *CAMERAS]) from None
        raise GymMaraError(f"pixel_{error}") from None


def _checked_randomisation(random: Any) -> dict[str, float] | None:
    if random is None:
        return None
    if not isinstance(random, Mapping):
        raise GymMaraError(
            f"pixel_randomisation must be a dictionary with some of {', '.join(RANDOM)}, not {short(random)}"
        )
    for name, amount in random.items():
        one_of("pixel_randomisation", name, RANDOM)
        number = isinstance(amount, (int, float, np.number)) and not isinstance(amount, bool)
        if not number or not 0.0 <= amount <= 1.0:
            raise GymMaraError(
                f"pixel_randomisation: {name} must be a number from 0 to 1, not {short(amount)}"
            )
    return {name: float(amount) for name, amount in random.items()}
