"""The statistics of an episode that gym-gazebo2 reports."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.arrays import host, is_tensor, namespace
from gym_mara.types import Array, Floats, Mask


class EpisodeStatistics:
    """The largest, mean and smallest distance and reward, and the number of collisions, of N running episodes.

    The names are those of gym-gazebo2. The distance is the root mean square of the position error over x, y and z, m.

    Args:
        num_envs: N.
        like: a tensor, for statistics that are tensors of its type and on its device; None for NumPy's arrays.
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

    def __init__(self, num_envs: int, like: Array | None = None) -> None:
        self._xp = xp = namespace(like)
        device = None if like is None else like.device
        self._dtype = xp.float64 if like is None else like.dtype
        # In float64 always: sums over an episode lose digits, and float32 counts no further than 16 million steps. One row
        # per name. The rows of means hold sums; the rows of steps and collisions hold counts.
        self._values = xp.zeros((len(self.NAMES), num_envs), dtype=xp.float64, device=device)
        self._max, self._min, self._sum = self._values[0:2], self._values[2:4], self._values[4:8]
        # The distance, the reward, the count 1 and the collision of one step.
        self._step = xp.ones((4, num_envs), dtype=xp.float64, device=device)
        self._extremes = self._step[:2]
        self.clear(slice(None))

    @property
    def steps(self) -> Floats:
        """The number of steps of each episode so far (N,)."""
        return self._values[6]

    def add(self, distance: Floats, reward: Floats, collided: Mask) -> None:
        """Add one step of every episode. All arrays are (N,); the distance is in m."""
        xp = self._xp
        self._step[0], self._step[1], self._step[3] = distance, reward, collided
        xp.maximum(self._max, self._extremes, out=self._max)
        xp.minimum(self._min, self._extremes, out=self._min)
        self._sum += self._step

    def clear(self, chosen: Mask | slice) -> None:
        """Start new statistics for the chosen episodes."""
        self._values[:, chosen] = 0.0
        self._max[:, chosen] = -np.inf
        self._min[:, chosen] = np.inf

    def summary(self) -> dict[str, NDArray[Any]]:
        """The statistics of every episode so far, each (N,)."""
        xp = self._xp
        values = xp.asarray(self._values, copy=True)
        values[4:6] /= xp.maximum(values[6], self._step[2])  # by at least 1 step
        counts = xp.asarray(values[6:], dtype=xp.int64)
        rows = (*xp.asarray(values[:6], dtype=self._dtype), *counts)
        return dict(zip(self.NAMES, rows, strict=True))

    def of(self, index: int) -> dict[str, float]:
        """The statistics of one episode so far, as plain numbers."""
        *values, dist_sum, rew_sum, steps, collisions = self._values[:, index].tolist()
        count = max(steps, 1.0)
        values += [dist_sum / count, rew_sum / count, int(steps), int(collisions)]
        return dict(zip(self.NAMES, values, strict=True))

    def copy(self, like: Array | None = None) -> EpisodeStatistics:
        """A copy in the library and on the device of another array; in NumPy's arrays without one."""
        return _restored(host(self._values), like)

    def __reduce__(self) -> tuple[Any, ...]:
        if not is_tensor(self._values):
            return _restored, (self._values,)
        like = self._values.new_empty(0, dtype=self._dtype)
        return _restored, (host(self._values), like)


def _restored(values: Floats, like: Array | None = None) -> EpisodeStatistics:
    statistics = EpisodeStatistics(values.shape[1], like)
    statistics._values[...] = namespace(like).asarray(values)
    return statistics
