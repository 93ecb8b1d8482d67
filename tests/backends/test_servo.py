"""The planned servo against its law integrated numerically, and what ServoBackend adds to an engine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gym_mara.backends.servo import Motion, ServoBackend, SimulationDivergedError
from gym_mara.backends.servo_motion import has_diverged, servo_motion
from gym_mara.robot import RobotModel
from gym_mara.state import Contact
from gym_mara.types import Floats

GAIN, LIMIT = np.array([10.0]), np.array([1.57])
angles = st.floats(-3.0, 3.0)


@given(angles, angles, st.floats(0.0, 3.0))
def test_it_moves_towards_the_target_and_does_not_overshoot(
    q: float, target: float, time: float
) -> None:
    moved = servo_motion(np.array([q]), np.array([target]), GAIN, LIMIT, np.array(time)).item()
    assert moved * (target - q) >= 0.0
    assert abs(moved) <= abs(target - q)


@given(angles, angles)
def test_it_is_not_faster_than_the_limit(q: float, target: float) -> None:
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
def test_a_motion_can_be_planned_in_parts(
    q: float, target: float, first: float, second: float
) -> None:
    def moved(start: float, time: float) -> float:
        ends = np.array([start]), np.array([target])
        return float(servo_motion(*ends, GAIN, LIMIT, np.array(time)).item())

    halfway = q + moved(q, first)
    whole = moved(q, first + second)
    np.testing.assert_allclose(halfway + moved(halfway, second), q + whole, rtol=0.0, atol=1e-9)


class IdealEngine(ServoBackend):
    """An engine that does what its motors are commanded, and diverges above a velocity of the first joint."""

    def __init__(self, robot: RobotModel, num_envs: int, **settings: Any) -> None:
        super().__init__(robot, num_envs, **settings)
        self.placed: list[tuple[int, Floats, Floats]] = []
        self.reset(np.tile(robot.home, (num_envs, 1)))

    def _run(self, velocities: Floats) -> Motion:
        q = self._q + self.physics_step * velocities.sum(axis=0)
        qd = velocities[-1].copy()
        wild = qd[:, 0] > 1.0
        qd[wild] = np.nan
        touching: tuple[Contact, ...] = (Contact(("a", "b"), 0.1),)
        contacts = [touching if each else () for each in wild]
        return Motion(q, qd, torque=qd.copy(), contacts=contacts)

    def _put_at_rest(self, arms: NDArray[np.intp], q: Floats) -> list[tuple[Contact, ...]]:
        return [(Contact(("a", "b"), 0.1),) if row[0] > 1.0 else () for row in q]

    def _set_parameters(self, arm: int, parameters: Mapping[str, Floats]) -> None:
        """This engine has none."""

    def _rebuild(self, arm: int, q: Floats, qd: Floats) -> None:
        self.placed.append((arm, q.copy(), qd.copy()))


def test_an_ideal_engine_moves_as_the_servo_plans(mara: RobotModel) -> None:
    backend = IdealEngine(mara, 2, servo_gain=5.0, max_joint_velocity=0.4)
    assert backend.joint_velocity.tolist() == [0.4] * 6
    target = np.array([[0.1] * 6, [-0.02] * 6])
    expected = servo_motion(
        np.zeros((2, 6)), target, np.full(6, 5.0), backend.joint_velocity, np.array(0.06)
    )
    for _ in range(3):
        state = backend.step(target)
    np.testing.assert_allclose(state.q, expected, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(state.time, 0.06)


def test_an_arm_that_diverges_is_rebuilt_where_it_was(mara: RobotModel) -> None:
    backend = IdealEngine(mara, 2, on_divergence="truncate")
    slow, fast = np.full(6, 0.05), np.full(6, 1.0)
    before = backend.step(np.array([slow, slow]))
    state = backend.step(np.array([slow, fast]))
    assert state.diverged is not None
    assert state.diverged.tolist() == [False, True]
    ((arm, q, qd),) = backend.placed
    assert arm == 1
    for reported, rebuilt, last in ((state.q, q, before.q), (state.qd, qd, before.qd)):
        np.testing.assert_array_equal(reported[1], last[1])
        np.testing.assert_array_equal(rebuilt, last[1])
    assert state.torque is not None
    assert state.torque[1].tolist() == [0.0] * 6
    # What an arm touches while it diverges is no collision.
    assert state.contacts == ((), ())
    assert not state.collided.any()


def test_an_arm_that_diverges_is_an_error_by_default(mara: RobotModel) -> None:
    backend = IdealEngine(mara, 2)
    with pytest.raises(SimulationDivergedError, match=r"arm 1 diverged 0\.020 s after its reset"):
        backend.step(np.array([np.zeros(6), np.ones(6)]))
    assert np.isfinite(backend.state.qd).all()
    assert backend.state.diverged is None


def test_after_that_error_the_other_arms_are_where_the_engine_has_them(mara: RobotModel) -> None:
    backend, alone = IdealEngine(mara, 2), IdealEngine(mara, 1)
    with pytest.raises(SimulationDivergedError):
        backend.step(np.array([np.full(6, 0.05), np.ones(6)]))
    expected = alone.step(np.full((1, 6), 0.05))
    assert (expected.q > 0.0).all()
    np.testing.assert_array_equal(backend.state.q, [expected.q[0], np.zeros(6)])
    np.testing.assert_array_equal(backend.state.qd, [expected.qd[0], np.zeros(6)])


def test_contacts_right_after_a_reset_are_those_of_the_engine(mara: RobotModel) -> None:
    backend = IdealEngine(mara, 2)
    backend.reset(np.array([[1.2] + [0.0] * 5, [0.0] * 6]))
    assert backend.state.contacts == ((Contact(("a", "b"), 0.1),), ())
    assert backend.state.collided.tolist() == [True, False]


@pytest.mark.parametrize(
    ("q", "qd", "expected"),
    [(0.0, 1e3, False), (0.0, 2e3, True), (np.inf, 0.0, True), (0.0, np.nan, True)],
)
def test_a_state_has_diverged_if_not_finite_or_far_too_fast(
    q: float, qd: float, expected: bool
) -> None:
    arms = has_diverged(
        np.array([[0.0, q], [0.0, 0.0]]), np.array([[0.0, qd], [0.0, 1.0]]), 2.0 * LIMIT / 1.57
    )
    assert arms.tolist() == [expected, False]
