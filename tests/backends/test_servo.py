"""The planned servo: the law it follows, integrated numerically, as referee."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from gym_mara.backends.servo import servo_motion

GAIN, LIMIT = np.array([10.0]), np.array([1.57])
angles = st.floats(-3.0, 3.0)


@given(angles, angles, st.floats(0.0, 3.0))
def test_it_goes_towards_the_target_and_never_past_it(q: float, target: float, time: float) -> None:
    moved = servo_motion(np.array([q]), np.array([target]), GAIN, LIMIT, np.array(time)).item()
    assert moved * (target - q) >= 0.0
    assert abs(moved) <= abs(target - q)


@given(angles, angles)
def test_it_is_no_faster_than_the_limit(q: float, target: float) -> None:
    times = np.linspace(0.0, 2.0, 200)[:, None]
    path = servo_motion(np.array([q]), np.array([target]), GAIN, LIMIT, times)
    speed = np.abs(np.diff(path, axis=0)) / np.diff(times, axis=0)
    assert (speed <= LIMIT + 1e-9).all()


@given(angles, angles, st.floats(0.0, 1.0))
def test_it_is_the_integral_of_the_law(q: float, target: float, time: float) -> None:
    steps = 4000
    position = q
    for _ in range(steps):
        position += np.clip(10.0 * (target - position), -1.57, 1.57) * time / steps
    moved = servo_motion(np.array([q]), np.array([target]), GAIN, LIMIT, np.array(time)).item()
    np.testing.assert_allclose(moved, position - q, rtol=0.0, atol=2e-3 * time + 1e-12)


@given(angles, angles, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_it_does_not_matter_where_a_motion_is_cut(
    q: float, target: float, first: float, second: float
) -> None:
    def moved(start: float, time: float) -> float:
        ends = np.array([start]), np.array([target])
        return float(servo_motion(*ends, GAIN, LIMIT, np.array(time)).item())

    halfway = q + moved(q, first)
    whole = moved(q, first + second)
    np.testing.assert_allclose(halfway + moved(halfway, second), q + whole, rtol=0.0, atol=1e-9)
