"""Logs: their period, which joints move, and every refusal."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gym_mara.errors import GymMaraError
from gym_mara.identification import Log
from gym_mara.types import Floats


def values(**changes: Any) -> dict[str, Any]:
    q = np.zeros((150, 2))
    q[:, 1] = np.linspace(0.0, 1.0, 150)
    return {"times": 0.02 * np.arange(150), "targets": q, "q": q, "qd": q} | changes


def test_a_log() -> None:
    log = Log(**values())
    assert log.control_period == 0.02
    assert log.duration == pytest.approx(2.98)
    assert log.moving == (1,)
    log.require(("a", "b"), "arm")


def with_nan() -> Floats:
    q = np.zeros((150, 2))
    q[7, 1] = np.nan
    return q


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"times": np.arange(150.0)[:, None]}, "needs times"),
        ({"q": np.zeros(150)}, "needs times"),
        ({"targets": np.zeros((150, 3))}, r"targets of a log must have a row .* shape \(150, 3\)"),
        ({"qd": np.zeros((149, 2))}, "qd of a log"),
        ({"qd": with_nan()}, "qd of the log is not finite at tick 7"),
        ({"times": 0.01 * np.arange(150)}, "too short: it has 1.49 s"),
        ({"times": 0.02 * np.arange(150) ** 1.5}, "evenly spaced"),
    ],
)
def test_refusals(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        Log(**values(**changes))


def test_an_empty_log_is_too_short() -> None:
    with pytest.raises(GymMaraError, match="too short"):
        Log(np.zeros(0), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros((0, 2)))


def test_an_arm_that_does_not_move() -> None:
    still = np.zeros((150, 2))
    for changes in ({"targets": still}, {"q": still}):
        with pytest.raises(GymMaraError, match="does not move"):
            _ = Log(**values(**changes)).moving


def test_another_arm() -> None:
    with pytest.raises(GymMaraError, match="the log has the joints b, a"):
        Log(**values(), joint_names=("b", "a")).require(("a", "b"), "arm")
    with pytest.raises(GymMaraError, match="2 joints, and arm has 3"):
        Log(**values()).require(("a", "b", "c"), "arm")
