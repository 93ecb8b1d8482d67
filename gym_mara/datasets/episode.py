"""An episode as data sets store it, and what cuts it out of the steps of N arms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.envs.outcome import Outcome
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.view import view_of
from gym_mara.rendering import Pictures
from gym_mara.rendering.settings import PIXELS, STATE
from gym_mara.rendering.view import View
from gym_mara.types import Floats, Mask


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode of T steps."""

    seed: int | None
    """Of `reset`, for the same start and target; None if a user has moved the target."""
    states: dict[str, Floats]
    """The observations (T + 1, O) by their keys, from the first one to the last; under STATE if they are no dictionary."""
    actions: NDArray[np.float32]
    """(T, A), clipped to the action space."""
    rewards: Floats
    """(T,)."""
    terminated: Mask
    """(T,)."""
    truncated: Mask
    """(T,)."""
    success: Mask | None
    """Whether the arm is within the task's tolerances after each step (T,); None if the task has none."""
    pixels: NDArray[np.uint8] | None = None
    """Pictures of the observations (T + 1, height, width, 3), RGB."""

    @property
    def observations(self) -> Any:
        """The observations in the form of the space of a data set, each array (T + 1, …)."""
        if self.pixels is not None:
            return {**self.states, PIXELS: self.pixels}
        return self.states.get(STATE, self.states)


class Steps:
    """The steps that N arms make side by side, from the start of their episodes on.

    Args:
        simulation: the arms, after their reset.
        observation: their first observations (N, …), as the environment returns them.
        pictures: draws the arms; None for no pictures.
    """

    def __init__(
        self, simulation: Simulation, observation: Any, pictures: Pictures | None = None
    ) -> None:
        self._simulation, self._pictures = simulation, pictures
        self._observations = [observation]
        self._views = [self._seen()]
        self._rows: list[tuple[Any, ...]] = []

    def __len__(self) -> int:
        """T, how many steps there are."""
        return len(self._rows)

    def add(
        self, observation: Any, action: NDArray[np.float32], outcome: Outcome, truncated: Mask
    ) -> None:
        """Add a step.

        Args:
            observation: the observations after it (N, …).
            action: the actions (N, A).
            outcome: what came of them.
            truncated: which episodes were cut off (N,).
        """
        info = outcome.info
        success = info.get("success", info.get("is_success"))
        row = action, outcome.reward, outcome.terminated, truncated, success
        self._rows.append(tuple(None if value is None else np.array(value) for value in row))
        self._observations.append(observation)
        self._views.append(self._seen())

    def _seen(self) -> list[View]:
        if self._pictures is None:
            return []
        return [view_of(self._simulation, arm) for arm in range(self._simulation.num_envs)]

    def episode(self, arm: int, length: int, seed: int | None) -> Episode:
        """The episode of an arm that has this many steps; its pictures are drawn now."""
        observations, rows = self._observations[: length + 1], self._rows[:length]
        if isinstance(observations[0], dict):
            states = {key: _column([o[key] for o in observations], arm) for key in observations[0]}
        else:
            states = {STATE: _column(observations, arm)}
        *columns, success = zip(*rows, strict=True)
        actions, rewards, terminated, truncated = (_column(values, arm) for values in columns)
        succeeded = None if success[0] is None else _column(success, arm)
        pixels = None
        if self._pictures is not None:
            pixels = _drawn(self._pictures, [seen[arm] for seen in self._views[: length + 1]])
        return Episode(seed, states, actions, rewards, terminated, truncated, succeeded, pixels)


def _drawn(pictures: Pictures, views: Sequence[View]) -> NDArray[np.uint8]:
    """The pictures of views (T, height, width, 3), each drawn into its place: two copies of all would be large."""
    first = pictures.of(views[0])
    drawn = np.empty((len(views), *first.shape), np.uint8)
    drawn[0] = first
    for index, view in enumerate(views[1:], start=1):
        drawn[index] = pictures.of(view)
    return drawn


def _column(values: Sequence[Any], arm: int) -> Any:
    return np.array([value[arm] for value in values])
