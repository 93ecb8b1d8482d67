"""Standard deviation and skewness of the distances and rewards of an episode, as gym-gazebo2 reports them."""

from __future__ import annotations

import numpy as np


class Moments:
    """Running moments of the distance and the reward of one episode.

    Each step updates the mean and the sums of squares and cubes of the differences from it (Pébay 2008, SAND2008-6212,
    equations 1.3 to 1.6), which is accurate where sums of powers are not.
    """

    def __init__(self) -> None:
        self.values = np.zeros((4, 2))
        """The number of steps, the mean, the sum of squares and the sum of cubes (4,), of distance and reward (2,)."""

    def add(self, distance: float, reward: float) -> None:
        """Add one step: the distance, m, and the reward."""
        count, mean, squares, cubes = self.values
        new = count + 1.0
        difference = np.array([distance, reward]) - mean
        share = difference / new
        added = difference * share * count
        cubes += added * share * (new - 2.0) - 3.0 * share * squares
        squares += added
        mean += share
        count += 1.0

    def summary(self) -> dict[str, float]:
        """The standard deviations and the skewnesses by gym-gazebo2's names; 0 for the skewness of equal values."""
        count, _, squares, cubes = self.values
        variance = squares / np.maximum(count, 1.0)
        power = np.sqrt(variance) ** 3
        third = cubes / np.maximum(count, 1.0)
        skewness = np.divide(third, power, out=np.zeros(2), where=power > 0.0)
        names = ("ep_dist_std", "ep_rew_std", "ep_dist_skew", "ep_rew_skew")
        return dict(zip(names, [*np.sqrt(variance).tolist(), *skewness.tolist()], strict=True))
