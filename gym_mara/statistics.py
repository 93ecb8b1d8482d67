"""Per-episode statistics, as gym-gazebo2 reports them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class EpisodeStatistics:
    """Largest, mean and smallest distance and reward, and the number of collisions, of N running episodes."""

    def __init__(self, num_envs: int) -> None:
        self.steps = np.zeros(num_envs, dtype=np.int64)
        self._collisions = np.zeros(num_envs, dtype=np.int64)
        # Rows: distance and reward.
        self._max = np.full((2, num_envs), -np.inf)
        self._min = np.full((2, num_envs), np.inf)
        self._sum = np.zeros((2, num_envs))

    def add(self, distance: Floats, reward: Floats, collided: NDArray[np.bool_]) -> None:
        """Count one step of every episode; all arrays (N,), distance in m."""
        values = np.array((distance, reward))
        self.steps += 1
        self._collisions += collided
        np.maximum(self._max, values, out=self._max)
        np.minimum(self._min, values, out=self._min)
        self._sum += values

    def clear(self, chosen: NDArray[np.bool_] | slice) -> None:
        """Begin the chosen episodes anew."""
        self.steps[chosen] = 0
        self._collisions[chosen] = 0
        self._max[:, chosen] = -np.inf
        self._min[:, chosen] = np.inf
        self._sum[:, chosen] = 0.0

    def summary(self) -> dict[str, NDArray[Any]]:
        """gym-gazebo2's figures and the number of steps, each (N,); its distance is the root mean square over x, y, z, m."""
        mean = self._sum / np.maximum(self.steps, 1)
        summary: dict[str, NDArray[Any]] = {
            "ep_steps": self.steps.copy(),
            "num_coll": self._collisions.copy(),
        }
        for row, name in enumerate(("dist", "rew")):
            summary[f"ep_{name}_max"] = self._max[row].copy()
            summary[f"ep_{name}_mean"] = mean[row]
            summary[f"ep_{name}_min"] = self._min[row].copy()
        return summary
