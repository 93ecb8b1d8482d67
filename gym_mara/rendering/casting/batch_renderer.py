"""Draws what cameras see of many arms: colours, depths and segments."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray

from gym_mara.errors import GymMaraError
from gym_mara.rendering.camera import VIEW_ANGLE, Camera, place_camera
from gym_mara.rendering.casting.appearance import Appearance
from gym_mara.rendering.casting.caster import Caster, Drawn
from gym_mara.rendering.scene import Scene
from gym_mara.rendering.settings import PIXELS, TOOL, PixelSettings, RenderSettings
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel
from gym_mara.types import Floats

_TOOL_EYE, _TOOL_AT = (-0.12, 0.0, -0.1), (-0.03, 0.0, 0.2)
"""Where the camera on the tool is and what it looks at, in the tool's frame, for an arm as long as MARA, m: beside the hand, along it."""
_ARMS_PER_THREAD = 8
"""Fewer arms are drawn in one thread."""
_TOOL_ANGLE = 70.0
"""Its vertical angle of view, deg."""
_MOST_SEGMENTS = 256
"""What a byte can number."""


class BatchRenderer:
    """Draws pictures of many arms at once.

    Args:
        settings: what is drawn.
        robot: the arm.
        first: the view that is used to place a named camera.

    Raises:
        GymMaraError: a mesh of the robot cannot be read, or the arm has more segments than a segmentation can number.
    """

    def __init__(self, settings: PixelSettings, robot: RobotModel, first: View) -> None:
        self._settings = settings
        self._scene = Scene(robot)
        height, width = settings.sides
        named: Any = "three_quarter" if settings.pixel_camera == TOOL else settings.pixel_camera
        chosen = RenderSettings(width=width, height=height, camera=named)
        self._camera = place_camera(self._scene, first, chosen)
        # One for each thread, because a caster keeps what it has drawn.
        self._casters: list[Caster] = []
        own = self._camera.eye, self._camera.at, self._camera.up
        if settings.pixel_camera == TOOL:
            size = self._scene.marker_scale
            own = size * np.array(_TOOL_EYE), size * np.array(_TOOL_AT), np.array([1.0, 0.0, 0.0])
        # The camera's position, the point that it looks at, and its upward direction, in the world or in the tool's frame.
        self._placed = own
        parts = self._scene.parts
        tool = next(i for i, part in enumerate(parts) if part.marker and part.link == "tool")
        self._tool_body = int(self._scene.body_of_part[tool])
        self._on_body = self._scene.on_body[tool]
        self._colours = np.array([part.colour for part in parts])
        self._marker = np.array([part.marker for part in parts])
        seen = list(dict.fromkeys((part.link, part.marker) for part in parts))
        self.segments: tuple[str, ...] = ("nothing", "floor", *(link for link, _ in seen))
        """What each number of a segmentation stands for; the last two are the frames, also if a link has the name of one."""
        if "segmentation" in settings.pixel_channels and len(self.segments) > _MOST_SEGMENTS:
            raise GymMaraError(
                f"{robot.name} has {len(self.segments)} segments, and a segmentation can number {_MOST_SEGMENTS}: leave "
                "'segmentation' out of pixel_channels"
            )
        # Of the part indices from -2 on; larger numbers than a byte's if there is no segmentation.
        numbers = [0, 1, *(2 + seen.index((part.link, part.marker)) for part in parts)]
        self._segment_of_part = np.array(numbers, np.min_scalar_type(max(numbers)))
        self.far = _farthest(self._camera, robot)
        """The largest depth, m: that of the background, too."""
        spaces: dict[str, Space[Any]] = {
            "rgb": Box(0, 255, (height, width, 3), np.uint8),
            "depth": Box(0.0, self.far, (height, width, 1), np.float32),
            "segmentation": Box(0, 255, (height, width, 1), np.uint8),
        }
        self.spaces = {_key(channel): spaces[channel] for channel in settings.pixel_channels}
        """The space of one arm's pictures, by their keys in an observation."""

    def check(self, first: View) -> None:
        """Check that the camera sees the arm.

        Raises:
            GymMaraError: it does not in this view.
        """
        part = self._draw([first], None).part
        seen = np.unique(part)
        where = f"the camera {self._settings.pixel_camera!r} of the observations"
        if len(seen) == 1 and seen[0] >= 0:
            inside = self._scene.parts[seen[0]].link
            remedy = "move it away, or leave out pixel_camera"
            if self._settings.pixel_camera == TOOL:
                remedy = (
                    f"it looks along z of the end-effector frame {self._scene.robot.ee_frame!r}; choose a link whose z points "
                    "out of the hand by ee_frame, or another pixel_camera"
                )
            raise GymMaraError(
                f"{where} sees nothing but {inside!r}: it is inside it or right before it; {remedy}"
            )
        if self._settings.pixel_camera != TOOL and not (seen >= 0).any():
            raise GymMaraError(
                f"{where} sees neither the arm at home nor its surroundings: let it look at the arm, or leave out pixel_camera"
            )

    def draw(
        self, views: Sequence[View], seeds: NDArray[np.uint64] | None
    ) -> dict[str, NDArray[Any]]:
        """Draw n arms.

        Args:
            views: of the arms.
            seeds: each decides the appearance of an arm (n,); None for the usual one.

        Returns:
            For each channel of the settings the pictures: "pixels", uint8 (n, H, W, 3), RGB; "depth", float32 (n, H, W, 1), m along the
            camera's axis; "segmentation", uint8 (n, H, W, 1), indices of `segments`.
        """
        colour, depth, part = self._draw(views, seeds)
        made: dict[str, NDArray[Any]] = {}
        for channel in self._settings.pixel_channels:
            if channel == "rgb":
                made[PIXELS] = colour
            elif channel == "depth":
                made["depth"] = np.minimum(depth, np.float32(self.far))[..., None]
            else:
                made["segmentation"] = self._segment_of_part[part + 2][..., None]
        return made

    def _draw(self, views: Sequence[View], seeds: NDArray[np.uint64] | None) -> Drawn:
        count, random = len(views), self._settings.pixel_randomisation or {}
        poses = np.array([self._scene.bodies(view) for view in views])
        eye, at, up = (np.tile(point, (count, 1)) for point in self._placed)
        generators = [] if seeds is None else [np.random.default_rng(seed) for seed in seeds]
        for i, generator in enumerate(generators):
            by = random.get("camera", 0.0)
            eye[i] += by * generator.uniform(-1.0, 1.0, 3)
            at[i] += by * generator.uniform(-1.0, 1.0, 3)
        angle = VIEW_ANGLE
        if self._settings.pixel_camera == TOOL:
            tool = poses[:, self._tool_body] @ self._on_body
            eye, at = (
                np.einsum("nij,nj->ni", tool[:, :3, :3], p) + tool[:, :3, 3] for p in (eye, at)
            )
            up, angle = np.einsum("nij,nj->ni", tool[:, :3, :3], up), _TOOL_ANGLE
        colours = np.broadcast_to(self._colours, (count, *self._colours.shape))
        appearance = Appearance.usual(eye, at, up, colours, angle)
        if generators:
            light, colour = (random.get(name, 0.0) for name in ("light", "colour"))
            appearance = appearance.randomised(generators, light, colour, self._marker)
        return self._cast(poses, appearance)

    def _cast(self, poses: Floats, appearance: Appearance) -> Drawn:
        """Draw the arms, many of them in several threads: NumPy and Embree release the interpreter lock for a part of the time."""
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
        threads = max(1, min(cores or 1, len(poses) // _ARMS_PER_THREAD))
        height, width = self._settings.sides
        while len(self._casters) < threads:
            moves = self._settings.pixel_camera == TOOL
            self._casters.append(Caster(self._scene, self._camera, width, height, moves=moves))
        if threads == 1:
            return self._casters[0].draw(poses, appearance)
        rows = np.array_split(np.arange(len(poses)), threads)
        with ThreadPoolExecutor(threads) as pool:
            drawn = pool.map(
                lambda i: self._casters[i].draw(poses[rows[i]], appearance.of(rows[i])),
                range(threads),
            )
            return Drawn._make(np.concatenate(values) for values in zip(*drawn, strict=True))


def _farthest(camera: Camera, robot: RobotModel) -> float:
    """A depth, whole m, beyond which is no part of the arm, and none of the floor where the camera looks at the arm."""
    floor = camera.floor_radius + np.linalg.norm(camera.eye - camera.at)
    arm = np.linalg.norm(camera.eye - camera.floor) + robot.extent
    return float(np.ceil(max(floor, arm)))


def _key(channel: str) -> str:
    return PIXELS if channel == "rgb" else channel
