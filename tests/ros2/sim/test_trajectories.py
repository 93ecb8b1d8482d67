"""Trajectories: what is refused, and the path through their points."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_mara.errors import GymMaraError
from gym_mara.ros2.sim.trajectories import Path, Point, Trajectory

NAMES = ("a", "b")


def of(*points: Point, names: tuple[str, ...] = NAMES) -> Trajectory:
    return Trajectory.of(NAMES, names, points)


def path(trajectory: Trajectory, now: float = 0.0, start: float = 0.0) -> Path:
    return Path(now, np.zeros(2), np.zeros(2), trajectory, start)


def test_joints_come_into_the_order_of_the_robot() -> None:
    trajectory = of(Point([1.0, 2.0], [3.0, 4.0], 1.0), names=("b", "a"))
    assert trajectory.q.tolist() == [[2.0, 1.0]]
    assert trajectory.qd is not None
    assert trajectory.qd.tolist() == [[4.0, 3.0]]


@pytest.mark.parametrize(
    ("names", "reason"),
    [
        (("a",), "b missing"),
        (("a", "b", "c"), "c unknown"),
        (("a", "a"), "b missing"),
        (("a", "b", "b"), "twice"),
        (("ur_a", "ur_b"), "ur_a, ur_b unknown"),
    ],
)
def test_other_names_are_refused(names: tuple[str, ...], reason: str) -> None:
    with pytest.raises(GymMaraError, match=reason):
        of(Point([0.0] * len(names), [], 1.0), names=names)


@pytest.mark.parametrize(
    "points",
    [
        [Point([0.0], [], 1.0)],
        [Point([0.0, 0.0, 0.0], [], 1.0)],
        [Point([0.0, 0.0], [0.0], 1.0)],
        [Point([0.0, math.nan], [], 1.0)],
        [Point([0.0, math.inf], [], 1.0)],
        [Point([0.0, 0.0], [math.nan, 0.0], 1.0)],
        [Point([0.0, 0.0], [], math.nan)],
        [Point([0.0, 0.0], [], -1.0)],
        [Point([0.0, 0.0], [], 1.0), Point([0.0, 0.0], [], 1.0)],
        [Point([0.0, 0.0], [], 2.0), Point([0.0, 0.0], [], 1.0)],
        [Point([0.0, 0.0], [], 1.0), Point([0.0, 0.0], [0.0, 0.0], 2.0)],
    ],
)
def test_bad_points_are_refused(points: list[Point]) -> None:
    with pytest.raises(GymMaraError):
        of(*points)


def test_without_velocities_the_way_is_straight() -> None:
    way = path(of(Point([1.0, -1.0], [], 1.0), Point([1.0, 1.0], [], 2.0)))
    for time, expected in ((0.0, (0.0, 0.0)), (0.5, (0.5, -0.5)), (1.5, (1.0, 0.0))):
        q, _ = way.at(time)
        assert q == pytest.approx(expected)
    assert way.at(0.5)[1] == pytest.approx([1.0, -1.0])


@given(st.lists(st.floats(-3.0, 3.0), min_size=8, max_size=8), st.floats(0.05, 2.0))
def test_with_velocities_positions_and_velocities_are_continuous(
    numbers: list[float], step: float
) -> None:
    (a, b), (c, d) = (np.reshape(numbers[i : i + 4], (2, 2)).tolist() for i in (0, 4))
    way = path(of(Point(a, b, step), Point(c, d, 2.0 * step)))
    tiny = 1e-7 * step
    for time, (q, qd) in ((0.0, ([0.0, 0.0], [0.0, 0.0])), (step, (a, b)), (2.0 * step, (c, d))):
        for near in (time - tiny, time + tiny):
            if 0.0 < near < way.end:
                there, moving = way.at(near)
                assert there == pytest.approx(q, abs=1e-4)
                assert moving == pytest.approx(qd, abs=1e-3 / step)


def test_it_rests_at_the_last_point() -> None:
    way = path(of(Point([1.0, 2.0], [0.5, 0.5], 0.001)))
    for time in (0.001, 0.02, 100.0):
        q, qd = way.at(time)
        assert q.tolist() == [1.0, 2.0]
        assert not qd.any()


def test_points_of_the_past_are_left_out() -> None:
    trajectory = of(Point([1.0, 1.0], [], 1.0), Point([2.0, 2.0], [], 2.0))
    late = path(trajectory, now=1.5)
    assert late.at(1.5)[0].tolist() == [0.0, 0.0]
    assert late.at(1.75)[0] == pytest.approx([1.0, 1.0])
    over = path(trajectory, now=5.0)
    assert over.at(5.0)[0].tolist() == [2.0, 2.0]


def test_a_start_in_the_future_gives_more_time() -> None:
    later = path(of(Point([1.0, 1.0], [], 1.0)), start=1.0)
    assert later.at(1.0)[0] == pytest.approx([0.5, 0.5])
