"""Pictures as observations: what a camera of the scene or on the tool sees of each of N arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Dict, Space
from numpy.typing import NDArray

from gym_mara.extras import needs
from gym_mara.rendering.settings import PIXELS, STATE, PixelSettings
from gym_mara.rendering.view import View
from gym_mara.robot import RobotModel

with needs("a picture as an observation", "render", "trimesh", "embreex"):
    from gym_mara.rendering.casting.batch_renderer import BatchRenderer


class Pixels:
    """Draws the observations of N arms.

    Args:
        settings: what is drawn; its `observation` is not "state".
        robot: the arm.
        num_envs: N.
        first: the view that is used to place a named camera.

    Raises:
        GymMaraError: the camera sees nothing of the arm in that view, or nothing but one part from within.
        MissingExtraError: a library is not installed.
    """

    def __init__(
        self, settings: PixelSettings, robot: RobotModel, num_envs: int, first: View
    ) -> None:
        self.settings = settings
        self._made_with = settings, robot, first
        self._renderer: BatchRenderer | None = BatchRenderer(*self._made_with)
        self._renderer.check(first)
        self.seeds: NDArray[np.uint64] = np.zeros(num_envs, np.uint64)
        """Each decides the appearance of an arm in its episode (N,)."""
        self.random = any((settings.pixel_randomisation or {}).values())
        """Whether each episode has another appearance."""

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"_renderer": None}  # a copy makes its own

    def begin(self, generators: Mapping[int, np.random.Generator]) -> None:
        """Choose how arms look in their next episodes; each index of an arm has its generator."""
        if self.random:
            for arm, generator in generators.items():
                self.seeds[arm] = generator.integers(2**63)

    @property
    def renderer(self) -> BatchRenderer:
        """What draws; each copy and each process has its own."""
        if self._renderer is None:
            self._renderer = BatchRenderer(*self._made_with)
        return self._renderer

    def space(self, own: Space[Any]) -> Space[Any]:
        """The space of one arm's observation, of which `own` is the space without pictures."""
        pictures = self.renderer.spaces
        if self.settings.observation == PIXELS:
            return pictures[PIXELS] if list(pictures) == [PIXELS] else Dict(pictures)
        return Dict({**(own.spaces if isinstance(own, Dict) else {STATE: own}), **pictures})

    def present(self, own: Any, views: Sequence[View], arms: NDArray[np.int64]) -> Any:
        """Observations with pictures.

        Args:
            own: the observations of n arms without pictures, an array (n, O) or a dictionary of arrays.
            views: of these arms.
            arms: their indices (n,).
        """
        pictures = self.renderer.draw(views, self.seeds[arms] if self.random else None)
        if self.settings.observation == PIXELS:
            return pictures[PIXELS] if list(pictures) == [PIXELS] else pictures
        return {**(own if isinstance(own, dict) else {STATE: own}), **pictures}
