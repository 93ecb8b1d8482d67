"""For authors of backends: the contract as a suite of tests, which every backend here passes too.

from gym_mara.testing import BackendContract, Make

class TestMyBackend(BackendContract):
    @pytest.fixture
    def make(self) -> Make:
        robot = RobotModel.load("mara")
        return lambda num_envs: MyBackend(robot, num_envs)
"""

from __future__ import annotations

import copy
import dataclasses
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from gym_mara.backends import Backend
from gym_mara.robot import RobotModel
from gym_mara.state import SimState

Floats = NDArray[np.float64]
Make = Callable[[int], Backend]
"""Makes a backend for N arms of MARA."""

COLLIDING_Q = (1.5, 2.0, 0.0, 0.0, 0.0, 0.0)
"""A configuration of MARA with its forearm in the table, and of FakeBackend beyond its wall."""


def pickled(thing: Any) -> Any:
    """What pickling and unpickling makes of it."""
    return pickle.loads(pickle.dumps(thing))


COPIES = (pytest.param(copy.deepcopy, id="deepcopy"), pytest.param(pickled, id="pickle"))
"""The two ways to duplicate an object."""


def uniform_q(robot: RobotModel, count: int, seed: int) -> Floats:
    """Configurations (N, J) all over what an action can ask for."""
    low, high = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    return np.random.default_rng(seed).uniform(low, high, (count, robot.num_joints))


def arrays_of(state: SimState) -> dict[str, NDArray[Any]]:
    """The arrays of a state by name."""
    values = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    return {name: value for name, value in values.items() if isinstance(value, np.ndarray)}


def assert_same_arrays(
    actual: dict[str, NDArray[Any]], expected: dict[str, NDArray[Any]], atol: float = 0.0
) -> None:
    """Equal names; equal flags and counts; floats equal within atol."""
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        if values.dtype.kind == "f":
            np.testing.assert_allclose(actual[name], values, rtol=0.0, atol=atol, err_msg=name)
        else:
            np.testing.assert_array_equal(actual[name], values, err_msg=name)


def assert_same_state(actual: SimState, expected: SimState, atol: float = 0.0) -> None:
    """Equal states; floats equal within atol."""
    assert_same_arrays(arrays_of(actual), arrays_of(expected), atol)


def _reset(backend: Backend, seed: int = 0) -> Floats:
    """Put the arms at configurations of their own."""
    q = uniform_q(backend.robot, backend.num_envs, seed)
    backend.reset(q)
    return q


def _run(backend: Backend, steps: int, seed: int = 1) -> list[SimState]:
    """The states of a number of steps towards random targets."""
    rng = np.random.default_rng(seed)
    targets = rng.uniform(-2.3, 2.3, (steps, backend.num_envs, backend.robot.num_joints))
    return [backend.step(target) for target in targets]


def _assert_same_run(backend: Backend, other: Backend) -> None:
    for mine, yours in zip(_run(backend, 10, seed=2), _run(other, 10, seed=2), strict=True):
        assert_same_state(yours, mine)


class BackendContract:
    """What every backend must do, with MARA; a subclass gives the fixture `make`."""

    def test_a_state_has_the_shapes_and_types_it_promises(self, make: Make) -> None:
        backend = make(3)
        _reset(backend)
        for state in (backend.state, *_run(backend, 2)):
            shapes = {
                name: (array.shape, array.dtype.type) for name, array in arrays_of(state).items()
            }
            assert shapes == {
                "q": ((3, 6), np.float64),
                "qd": ((3, 6), np.float64),
                "ee_position": ((3, 3), np.float64),
                "ee_quaternion": ((3, 4), np.float64),
                "ee_velocity": ((3, 3), np.float64),
                "collided": ((3,), np.bool_),
                "time": ((3,), np.float64),
            }
            for name, array in arrays_of(state).items():
                assert np.isfinite(array).all(), name

    def test_reset_puts_the_arms_at_rest_at_q_with_time_at_zero(self, make: Make) -> None:
        backend = make(3)
        _run(backend, 3)
        q = _reset(backend)
        np.testing.assert_array_equal(backend.state.q, q)
        for array in (backend.state.qd, backend.state.ee_velocity, backend.state.time):
            assert not array.any()

    def test_reset_takes_a_copy_of_q(self, make: Make) -> None:
        backend = make(2)
        q = _reset(backend)
        kept = q.copy()
        _run(backend, 1)
        np.testing.assert_array_equal(q, kept)
        backend.reset(q)
        q[...] = 0.1
        np.testing.assert_array_equal(backend.state.q, kept)

    def test_the_pose_is_that_of_the_robot_at_q(self, make: Make) -> None:
        backend = make(3)
        _reset(backend)
        for state in (backend.state, *_run(backend, 3)):
            position, quaternion = backend.robot.kinematics().pose(state.q)
            np.testing.assert_allclose(state.ee_position, position, rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(state.ee_quaternion, quaternion, rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(np.linalg.norm(state.ee_quaternion, axis=1), 1.0, atol=1e-12)
            assert (state.ee_quaternion[:, 0] >= 0.0).all()

    def test_the_velocity_is_that_of_the_robot_at_q_and_qd(self, make: Make) -> None:
        backend = make(3)
        _reset(backend)
        for state in _run(backend, 3):
            velocity = backend.robot.kinematics().velocity(state.q, state.qd)
            np.testing.assert_allclose(state.ee_velocity, velocity, rtol=0.0, atol=1e-9)

    def test_joints_are_no_faster_than_the_backend_says(self, make: Make) -> None:
        backend = make(3)
        _reset(backend)
        for state in _run(backend, 5):
            assert (np.abs(state.qd) <= backend.joint_velocity + 1e-9).all()

    def test_a_step_lasts_one_control_period(self, make: Make) -> None:
        backend = make(2)
        _reset(backend)
        for number, state in enumerate(_run(backend, 4), start=1):
            np.testing.assert_allclose(state.time, number * backend.control_period, atol=1e-12)

    def test_a_step_moves_the_arm_towards_its_target(self, make: Make) -> None:
        backend = make(1)
        backend.reset(np.zeros((1, 6)))
        target = np.full((1, 6), -0.5)
        before = np.abs(backend.state.q - target)
        after = np.abs(backend.step(target).q - target)
        assert (after < before).all()

    def test_step_leaves_the_target_as_it_is_and_takes_a_copy(self, make: Make) -> None:
        backend = make(2)
        backend.reset(np.zeros((2, 6)))
        target = np.full((2, 6), 0.4)
        first = backend.step(target)
        np.testing.assert_array_equal(target, np.full((2, 6), 0.4))
        target[...] = -1.0
        assert_same_state(backend.state, first)

    def test_the_state_after_a_step_is_what_the_step_returned(self, make: Make) -> None:
        backend = make(3)
        _reset(backend)
        for _ in range(3):
            (returned,) = _run(backend, 1)
            assert_same_state(backend.state, returned)

    def test_a_state_is_never_changed_afterwards(self, make: Make) -> None:
        backend = make(3)
        _reset(backend)
        states = [backend.state, *_run(backend, 2)]
        kept = [{name: a.copy() for name, a in arrays_of(state).items()} for state in states]
        _run(backend, 3)
        backend.reset(np.zeros((3, 6)), np.array([True, False, False]))
        _reset(backend, seed=5)
        for state, before in zip(states, kept, strict=True):
            assert_same_arrays(arrays_of(state), before)

    def test_who_writes_into_a_state_changes_no_other(self, make: Make) -> None:
        backend = make(2)
        _reset(backend)
        (state,) = _run(backend, 1)
        before = copy.deepcopy(backend.state)
        for array in arrays_of(state).values():
            array[...] = 1
        assert_same_state(backend.state, before)

    def test_a_masked_reset_touches_none_but_those_it_names(self, make: Make) -> None:
        backend, untouched = make(3), make(3)
        for each in (backend, untouched):
            each.reset(np.zeros((3, 6)))
            for _ in range(2):
                each.step(np.full((3, 6), 0.3))
        mask = np.array([False, True, False])
        backend.reset(np.full((3, 6), -0.7), mask)
        state, before = backend.state, untouched.state
        np.testing.assert_array_equal(state.q[1], np.full(6, -0.7))
        assert state.time[1] == 0.0
        assert not state.qd[1].any()
        others = {name: array[~mask] for name, array in arrays_of(state).items()}
        assert_same_arrays(others, {n: array[~mask] for n, array in arrays_of(before).items()})
        later, expected = backend.step(np.zeros((3, 6))), untouched.step(np.zeros((3, 6)))
        others = {name: array[~mask] for name, array in arrays_of(later).items()}
        assert_same_arrays(others, {n: array[~mask] for n, array in arrays_of(expected).items()})

    def test_right_after_a_reset_collided_says_whether_links_touch(self, make: Make) -> None:
        backend = make(2)
        backend.reset(np.array([COLLIDING_Q, np.zeros(6)]))
        assert backend.state.collided.tolist() == [True, False]
        backend.reset(np.zeros((2, 6)), np.array([True, False]))
        assert backend.state.collided.tolist() == [False, False]
        backend.reset(np.array([COLLIDING_Q] * 2), np.array([False, True]))
        assert backend.state.collided.tolist() == [False, True]

    def test_a_collision_on_the_way_is_reported(self, make: Make) -> None:
        backend = make(2)
        backend.reset(np.zeros((2, 6)))
        target = np.array([COLLIDING_Q, np.zeros(6)])
        collided = np.array([backend.step(target).collided for _ in range(200)])
        assert collided.any(axis=0).tolist() == [True, False]

    @pytest.mark.parametrize("count", [3, 40])
    def test_an_arm_does_not_depend_on_the_others(self, make: Make, count: int) -> None:
        together = make(count)
        q = _reset(together)
        # Some joints rest: the arms' ways differ in length.
        rng = np.random.default_rng(3)
        rests = rng.random((6, count, 6)) < rng.random((6, count, 1))
        targets = np.where(rests, q, rng.uniform(-2.3, 2.3, (6, count, 6)))
        states = [together.step(target) for target in targets]
        for arm in range(0, count, max(1, count // 8)):
            one = slice(arm, arm + 1)
            alone = make(1)
            alone.reset(q[one])
            for state, target in zip(states, targets, strict=True):
                expected = arrays_of(alone.step(target[one]))
                mine = {name: array[one] for name, array in arrays_of(state).items()}
                assert_same_arrays(mine, expected, atol=1e-12)

    def test_from_a_snapshot_it_goes_on_identically(self, make: Make) -> None:
        backend = make(3)
        _reset(backend)
        _run(backend, 3)
        snapshot, state = backend.save(), backend.state
        first = _run(backend, 4)
        for _ in range(2):
            backend.restore(snapshot)
            assert_same_state(backend.state, state)
            for mine, again in zip(first, _run(backend, 4), strict=True):
                assert_same_state(again, mine)

    def test_a_snapshot_of_just_after_a_reset_holds_too(self, make: Make) -> None:
        backend = make(2)
        backend.reset(np.array([COLLIDING_Q, np.zeros(6)]))
        snapshot = backend.save()
        _run(backend, 2)
        backend.restore(snapshot)
        assert backend.state.collided.tolist() == [True, False]
        assert not backend.state.time.any()

    def test_a_snapshot_pickles_and_fits_another_backend_made_alike(self, make: Make) -> None:
        backend, other = make(3), make(3)
        _reset(backend)
        _run(backend, 3)
        other.restore(pickled(backend.save()))
        _assert_same_run(backend, other)

    @pytest.mark.parametrize("duplicate", COPIES)
    def test_a_copy_goes_on_identically_and_apart(
        self, make: Make, duplicate: Callable[[Backend], Backend]
    ) -> None:
        backend = make(3)
        _reset(backend)
        _run(backend, 3)
        other, state = duplicate(backend), backend.state
        assert_same_state(other.state, state)
        _run(other, 2, seed=9)
        assert_same_state(backend.state, state)
        _assert_same_run(duplicate(backend), backend)

    def test_equal_backends_do_equally(self, make: Make) -> None:
        backend, other = make(3), make(3)
        _reset(backend)
        _reset(other)
        _assert_same_run(backend, other)

    def test_limits_are_kept_where_targets_are_at_them(self, make: Make) -> None:
        backend = make(2)
        robot = backend.robot
        backend.reset(np.array([robot.lower, robot.upper]))
        for _ in range(5):
            state = backend.step(np.array([robot.upper, robot.lower]))
            assert (state.q >= robot.lower).all()
            assert (state.q <= robot.upper).all()

    def test_close_frees_it(self, make: Make) -> None:
        backend = make(1)
        _reset(backend)
        (state,) = _run(backend, 1)
        kept = copy.deepcopy(state)
        backend.close()
        assert_same_state(state, kept)
