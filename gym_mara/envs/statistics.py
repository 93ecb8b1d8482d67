"""The statistics of an episode that gym-gazebo2 reports."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class EpisodeStatistics:
    """The largest, mean and smallest distance and reward, and the number of collisions, of N running episodes.

    The names are those of gym-gazebo2. The distance is the root mean square of the position error over x, y and z, m.
    """

    NAMES = (
        "ep_dist_max",
        "ep_rew_max",
        "ep_dist_min",
        "ep_rew_min",
        "ep_dist_mean",
        "ep_rew_mean",
        "ep_steps",
        "num_coll",
    )

    def __init__(self, num_envs: int) -> None:
        # One row per name. The rows of means hold sums; the rows of steps and collisions hold counts.
        self._values = np.zeros((len(self.NAMES), num_envs))
        self._max, self._min, self._sum = self._values[0:2], self._values[2:4], self._values[4:8]
        # The distance, the reward, the count 1 and the collision of one step.
        self._step = np.ones((4, num_envs))
        self._extremes = self._step[:2]
        self.clear(slice(None))

    @property
    def steps(self) -> Floats:
        """The number of steps of each episode so far (N,)."""
        return self._values[6]

    def add(self, distance: Floats, reward: Floats, collided: NDArray[np.bool_]) -> None:
        """Add one step of every episode. All arrays are (N,); the distance is in m."""
        self._step[0], self._step[1], self._step[3] = distance, reward, collided
        np.maximum(self._max, self._extremes, out=self._max)
        np.minimum(self._min, self._extremes, out=self._min)
        self._sum += self._step

    def clear(self, chosen: NDArray[np.bool_] | slice) -> None:
        """Start new statistics for the chosen episodes."""
        self._values[:, chosen] = 0.0
        self._max[:, chosen] = -np.inf
        self._min[:, chosen] = np.inf

    def summary(self) -> dict[str, NDArray[Any]]:
        """The statistics of every episode so far, each (N,)."""
        values = self._values.copy()
        values[4:6] /= np.maximum(values[6], 1.0)
        summary: dict[str, NDArray[Any]] = dict(zip(self.NAMES, values, strict=True))
        for name in ("ep_steps", "num_coll"):
            summary[name] = summary[name].astype(np.int64)
        return summary

    def of(self, index: int) -> dict[str, float]:
        """The statistics of one episode so far, as plain numbers."""
        *values, dist_sum, rew_sum, steps, collisions = self._values[:, index].tolist()
        count = max(steps, 1.0)
        values += [dist_sum / count, rew_sum / count, int(steps), int(collisions)]
        return dict(zip(self.NAMES, values, strict=True))

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self._values,)


def _restored(values: Floats) -> EpisodeStatistics:
    statistics = EpisodeStatistics(values.shape[1])
    statistics._values[...] = values
    return statistics
