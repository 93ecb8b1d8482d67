"""The check of a snapshot against an example."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from gym_mara.errors import GymMaraError
from gym_mara.snapshots import check_fits

LIKE: dict[str, Any] = {"q": np.zeros((2, 3)), "n": 1, "x": 0.5, "pair": (np.zeros(2, bool), dict)}


def test_a_value_of_the_same_form_fits() -> None:
    fitting = {"q": np.ones((2, 3)), "n": 7, "x": -1.0, "pair": (np.ones(2, bool), {"any": 1})}
    check_fits("snapshot", fitting, LIKE)


@pytest.mark.parametrize(
    "change",
    [
        {"q": np.zeros((2, 4))},
        {"q": np.full((2, 3), math.nan)},
        {"q": np.zeros((2, 3), int)},
        {"q": [[0.0] * 3] * 2},
        {"n": 1.0},
        {"n": True},
        {"x": math.inf},
        {"pair": [np.zeros(2, bool), {}]},
        {"pair": (np.zeros(2, bool),)},
        {"pair": (np.zeros(2, bool), None)},
        {"more": 1},
    ],
)
def test_a_value_of_another_form_is_named(change: dict[str, Any]) -> None:
    with pytest.raises(GymMaraError, match="of the snapshot does not fit here"):
        check_fits("snapshot", LIKE | change, LIKE)
