"""The statistics of a feature, with which policies of LeRobot normalise: of an episode, and of all episodes so far."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.types import Floats

QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
_MOST_PICTURES = 100
"""So many pictures of an episode are looked at."""

Statistics = dict[str, Floats]
"""`min`, `max`, `mean`, `std` and the QUANTILES, in the shape of a feature, and `count` (1,)."""


def of_values(values: NDArray[Any]) -> Statistics:
    """The statistics of values (T, K), each (K,)."""
    numbers = values.astype(np.float64)
    found = {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)]),
    }
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=0)
    return found | dict(zip(QUANTILES, quantiles, strict=True))


def of_pictures(pictures: NDArray[np.uint8]) -> Statistics:
    """The statistics of the channels of pictures (T, height, width, 3), in [0, 1], each (3, 1, 1)."""
    count = min(len(pictures), _MOST_PICTURES)
    counts = np.zeros((3, 256), np.int64)
    for index in np.linspace(0, len(pictures) - 1, count).astype(int):
        for channel in range(3):
            values = pictures[index, ..., channel].reshape(-1)
            counts[channel] += np.bincount(values, minlength=256)
    of_channels = [_of_counts(each) for each in counts]
    shaped = {
        name: np.array([found[name] for found in of_channels]).reshape(3, 1, 1)
        for name in of_channels[0]
    }
    return shaped | {"count": np.array([count])}


def _of_counts(counts: NDArray[np.int64]) -> dict[str, float]:
    """The statistics of values in 0, 1/255, …, 1, from how often there is each (256,): the values themselves would take much memory."""
    levels = np.arange(256) / 255.0
    until = np.cumsum(counts)
    total = int(until[-1])
    mean = float(counts @ levels / total)

    def ranked(rank: int) -> float:
        return float(levels[np.searchsorted(until, rank, side="right")])

    found = {
        "min": ranked(0),
        "max": ranked(total - 1),
        "mean": mean,
        "std": math.sqrt(counts @ (levels - mean) ** 2 / total),
    }
    for name, share in QUANTILES.items():  # linear between two ranks, as in `np.quantile`
        place = share * (total - 1)
        low, high = ranked(math.floor(place)), ranked(math.ceil(place))
        found[name] = low + (place - math.floor(place)) * (high - low)
    return found


def merged(first: Statistics, second: Statistics) -> Statistics:
    """The statistics of two groups of values together. Quantiles are the mean of the groups', as LeRobot merges them."""
    count = first["count"] + second["count"]
    share = float(second["count"][0] / count[0])
    mean = (1.0 - share) * first["mean"] + share * second["mean"]
    square = sum(
        part * (group["std"] ** 2 + (group["mean"] - mean) ** 2)
        for part, group in ((1.0 - share, first), (share, second))
    )
    return {
        "min": np.minimum(first["min"], second["min"]),
        "max": np.maximum(first["max"], second["max"]),
        "mean": mean,
        "std": np.sqrt(square),
        "count": count,
        **{name: (1.0 - share) * first[name] + share * second[name] for name in QUANTILES},
    }
