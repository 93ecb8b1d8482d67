"""Pictured: the observations of a simulation with pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Space
from numpy.typing import NDArray

from gym_mara.envs.view import first_view, view_of
from gym_mara.errors import GymMaraError
from gym_mara.rendering.pixels import Pixels
from gym_mara.rendering.settings import JOINTS
from gym_mara.tasks.observation import OF_THE_ROBOT
from gym_mara.types import Floats, Mask

if TYPE_CHECKING:
    from gym_mara.envs.simulation import Simulation


class Pictured:
    """Adds pictures to the observations of a simulation.

    Args:
        simulation: its options say what is observed.

    Raises:
        GymMaraError: its arrays are tensors, its camera sees nothing, or its task observes nothing of the robot.
        MissingExtraError: a library is not installed.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.settings, arrays = simulation.options.pixels, simulation.backend.arrays
        if arrays != "numpy":
            raise GymMaraError(
                f"pictures are NumPy's arrays: leave out arrays={arrays!r}, or observation={self.settings.observation!r}"
            )
        # The parts that are observed beside pictures, and their columns in flat observations; None for all.
        self._own = None
        if self.settings.observation == JOINTS:
            self._own = simulation.observation.only(OF_THE_ROBOT)
        self._pixels = Pixels(
            self.settings, simulation.robot, simulation.num_envs, first_view(simulation)
        )

    @property
    def random(self) -> bool:
        """Whether each episode has another appearance."""
        return self._pixels.random

    @property
    def segments(self) -> tuple[str, ...]:
        """What each number of a segmentation stands for: "nothing", "floor", the links, and the frames "target" and "tool"."""
        return self._pixels.renderer.segments

    def space(self, form: Space[Any]) -> Space[Any]:
        """The space of one arm's observation, of which `form` is the space without pictures."""
        return self._pixels.space(form if self._own is None else self._own[0].space)

    def present(self, simulation: Simulation, flat: Floats, arms: NDArray[np.int64] | None) -> Any:
        """The observations of arms with pictures, as `Simulation.present`."""
        chosen = np.arange(simulation.num_envs) if arms is None else arms
        views = [view_of(simulation, arm) for arm in chosen.tolist()]
        own = simulation.form(flat) if self._own is None else flat[:, self._own[1]]
        return self._pixels.present(own, views, chosen)

    def begin(self, simulation: Simulation, mask: Mask | None) -> None:
        """Choose how the arms of a mask (N,), or all, look in their new episodes."""
        if self.random:
            arms = np.arange(simulation.num_envs) if mask is None else np.flatnonzero(mask)
            self._pixels.begin({arm: simulation.streams[arm].pixels for arm in arms.tolist()})

    def save(self) -> NDArray[np.uint64]:
        """What decides the appearance of each arm (N,), for a snapshot."""
        return self._pixels.seeds.copy()

    def restore(self, saved: NDArray[np.uint64]) -> None:
        """Restore what `save` has returned."""
        self._pixels.seeds = saved.copy()
