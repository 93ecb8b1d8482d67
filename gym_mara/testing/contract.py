"""The contract of a backend as a suite of tests."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gym_mara.backends import Backend
from gym_mara.robot import RobotModel
from gym_mara.state import Contact, SimState
from gym_mara.testing.states import (
    COPIES,
    arms_of,
    arrays_of,
    assert_same_state,
    colliding_q,
    pickled,
    uniform_q,
)
from gym_mara.types import Floats

Make = Callable[[int], Backend]
"""Makes a backend for N arms of one robot, which must be able to collide."""


def _away(robot: RobotModel, distance: float) -> Floats:
    """A configuration (J,) with each joint this far from home, rad, on the side with more room; less at a limit."""
    up = robot.upper - robot.home >= robot.home - robot.lower
    return np.clip(robot.home + np.where(up, distance, -distance), robot.lower, robot.upper)


def _all_at(backend: Backend, q: Floats) -> Floats:
    """The same configuration (J,) for every arm (N, J)."""
    return np.tile(q, (backend.num_envs, 1))


def _stored(backend: Backend, values: Floats) -> Floats:
    """Values as the backend stores them, which may be in single precision."""
    return values.astype(backend.precision).astype(np.float64)


def _reset(backend: Backend, seed: int = 0) -> Floats:
    """Put each arm at a random configuration."""
    q = uniform_q(backend.robot, backend.num_envs, seed)
    backend.reset(q)
    return q


def _run(backend: Backend, steps: int, seed: int = 1) -> list[SimState]:
    """The states of a number of steps towards random targets."""
    targets = uniform_q(backend.robot, steps * backend.num_envs, seed, furthest=2.3)
    return [backend.step(target) for target in np.split(targets, steps)]


def _assert_same_run(backend: Backend, other: Backend) -> None:
    for mine, theirs in zip(_run(backend, 10, seed=2), _run(other, 10, seed=2), strict=True):
        assert_same_state(theirs, mine)


class BackendContract:
    """What every backend must do, with any robot that can collide; a subclass gives the fixture `make`."""

    @pytest.fixture
    def robot(self, make: Make) -> RobotModel:
        """The robot of the backends that `make` makes."""
        return make(1).robot

    def test_the_attributes_have_their_shapes_and_ranges(
        self, make: Make, robot: RobotModel
    ) -> None:
        backend = make(2)
        assert backend.num_envs == 2
        assert backend.joint_velocity.shape == (robot.num_joints,)
        assert (backend.joint_velocity > 0.0).all()
        assert 0.0 < backend.control_period < np.inf

    def test_a_state_has_the_documented_shapes_and_types(
        self, make: Make, robot: RobotModel
    ) -> None:
        backend = make(3)
        _reset(backend)
        joints = robot.num_joints
        shapes: dict[str, Any] = {
            "q": ((3, joints), np.float64),
            "qd": ((3, joints), np.float64),
            "ee_position": ((3, 3), np.float64),
            "ee_quaternion": ((3, 4), np.float64),
            "ee_velocity": ((3, 3), np.float64),
            "collided": ((3,), np.bool_),
            "time": ((3,), np.float64),
        }
        may_be_none = {"torque": ((3, joints), np.float64), "diverged": ((3,), np.bool_)}
        for state in (backend.state, *_run(backend, 2)):
            shapes |= {n: s for n, s in may_be_none.items() if getattr(state, n) is not None}
            arrays = arrays_of(state)
            own = {n: (a.shape, a.dtype.type) for n, a in arrays.items() if "." not in n}
            assert own == shapes
            for name, array in arrays.items():
                assert len(array) == 3, name
                assert np.isfinite(array).all(), name
            assert state.diverged is None or not state.diverged.any()

    def test_the_same_fields_are_none_in_every_state(self, make: Make, robot: RobotModel) -> None:
        backend = make(2)
        states = [backend.state]
        _reset(backend)
        states += [backend.state, *_run(backend, 2)]
        snapshot = backend.save()
        backend.reset(_all_at(backend, robot.home), np.array([True, False]))
        states.append(backend.state)
        backend.restore(snapshot)
        states.append(backend.state)
        names = [field.name for field in dataclasses.fields(SimState)]
        assert len({tuple(getattr(s, name) is None for name in names) for s in states}) == 1

    def test_reset_puts_the_arms_at_rest_at_q_with_time_at_zero(self, make: Make) -> None:
        backend = make(3)
        _run(backend, 3)
        q = _reset(backend)
        state = backend.state
        np.testing.assert_array_equal(state.q, _stored(backend, q))
        for array in (state.qd, state.ee_velocity, state.time):
            assert not array.any()
        assert state.torque is None or not state.torque.any()

    def test_reset_takes_a_copy_of_q(self, make: Make, robot: RobotModel) -> None:
        backend = make(2)
        q = _reset(backend)
        kept = q.copy()
        _run(backend, 1)
        np.testing.assert_array_equal(q, kept)
        backend.reset(q)
        q[...] = robot.home
        np.testing.assert_array_equal(backend.state.q, _stored(backend, kept))

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

    def test_joints_are_not_faster_than_joint_velocity(self, make: Make) -> None:
        backend = make(3)
        limit = backend.joint_velocity
        _reset(backend)
        for state in _run(backend, 5):
            highest = np.maximum(limit, _stored(backend, limit))
            assert (np.abs(state.qd) <= highest + 1e-9).all()

    def test_a_step_lasts_one_control_period(self, make: Make) -> None:
        backend = make(2)
        _reset(backend)
        for number, state in enumerate(_run(backend, 4), start=1):
            np.testing.assert_allclose(state.time, number * backend.control_period, atol=1e-12)

    def test_a_step_moves_the_arm_towards_its_target(self, make: Make, robot: RobotModel) -> None:
        backend = make(1)
        backend.reset(robot.home[None])
        target = _away(robot, 0.5)[None]
        before = np.abs(backend.state.q - target)
        after = np.abs(backend.step(target).q - _stored(backend, target))
        assert (after < before).all()
        assert backend.teleports == (not after.any())

    def test_step_takes_a_copy_of_the_target(self, make: Make, robot: RobotModel) -> None:
        backend = make(2)
        backend.reset(_all_at(backend, robot.home))
        target = _all_at(backend, _away(robot, 0.4))
        kept = target.copy()
        first = backend.step(target)
        np.testing.assert_array_equal(target, kept)
        target[...] = robot.home
        assert_same_state(backend.state, first)

    def test_the_state_after_a_step_is_what_the_step_returned(self, make: Make) -> None:
        backend = make(3)
        _reset(backend)
        for _ in range(3):
            (returned,) = _run(backend, 1)
            assert_same_state(backend.state, returned)

    def test_a_state_does_not_change_later(self, make: Make, robot: RobotModel) -> None:
        backend = make(3)
        _reset(backend)
        states = [backend.state, *_run(backend, 2)]
        kept = copy.deepcopy(states)
        _run(backend, 3)
        mask = np.array([True, False, False])
        backend.begin_episodes(np.arange(3, dtype=np.uint64), mask)
        backend.reset(_all_at(backend, robot.home), mask)
        _reset(backend, seed=5)
        for state, before in zip(states, kept, strict=True):
            assert_same_state(state, before)

    def test_writing_to_a_state_changes_no_other(self, make: Make) -> None:
        backend = make(2)
        _reset(backend)
        (state,) = _run(backend, 1)
        before = copy.deepcopy(backend.state)
        for array in arrays_of(state).values():
            if array.flags.writeable:
                array[...] = 1
        assert_same_state(backend.state, before)

    def test_a_masked_reset_leaves_the_other_arms_alone(
        self, make: Make, robot: RobotModel
    ) -> None:
        backend, untouched = make(3), make(3)
        home, near, other = (_all_at(backend, _away(robot, d)) for d in (0.0, 0.3, 0.7))
        for each in (backend, untouched):
            each.reset(home)
            for _ in range(2):
                each.step(near)
        mask = np.array([False, True, False])
        backend.reset(other, mask)
        state = backend.state
        np.testing.assert_array_equal(state.q[1], _stored(backend, other[1]))
        assert state.time[1] == 0.0
        assert not state.qd[1].any()
        assert_same_state(arms_of(state, ~mask), arms_of(untouched.state, ~mask))
        later, expected = backend.step(home), untouched.step(home)
        assert_same_state(arms_of(later, ~mask), arms_of(expected, ~mask))

    def test_a_masked_reset_leaves_arms_alone_that_touch_or_have_touched(
        self, make: Make, robot: RobotModel
    ) -> None:
        backend, untouched = make(3), make(3)
        target = _all_at(backend, robot.home)
        start = target.copy()
        start[[0, 2]] = colliding_q(robot)
        for each in (backend, untouched):
            each.reset(start)
        mask = np.array([False, True, False])
        for _ in range(8):  # on its way out an arm may touch on its path alone
            backend.reset(target, mask)
            assert_same_state(arms_of(backend.state, ~mask), arms_of(untouched.state, ~mask))
            left, expected = backend.step(target), untouched.step(target)
            assert_same_state(arms_of(left, ~mask), arms_of(expected, ~mask))
            backend.reset(target, mask)
            assert_same_state(arms_of(backend.state, ~mask), arms_of(expected, ~mask))

    def test_right_after_a_reset_collided_says_whether_links_touch(
        self, make: Make, robot: RobotModel
    ) -> None:
        backend = make(2)
        free, colliding = robot.home, np.array(colliding_q(robot))
        backend.reset(np.array([colliding, free]))
        assert backend.state.collided.tolist() == [True, False]
        backend.reset(np.array([free, free]), np.array([True, False]))
        assert backend.state.collided.tolist() == [False, False]
        backend.reset(np.array([colliding, colliding]), np.array([False, True]))
        assert backend.state.collided.tolist() == [False, True]

    def test_a_collision_on_the_way_is_reported(self, make: Make, robot: RobotModel) -> None:
        backend = make(2)
        backend.reset(_all_at(backend, robot.home))
        target = np.array([colliding_q(robot), robot.home])
        collided = np.array([backend.step(target).collided for _ in range(200)])
        assert collided.any(axis=0).tolist() == [True, False]

    def test_contacts_are_reported_for_exactly_the_arms_that_collided(
        self, make: Make, robot: RobotModel
    ) -> None:
        backend = make(3)
        backend.reset(np.array([colliding_q(robot), robot.home, _away(robot, 0.7)]))
        for state in (backend.state, *_run(backend, 5)):
            if state.contacts is None:
                continue
            assert isinstance(state.contacts, tuple)
            assert [bool(contacts) for contacts in state.contacts] == state.collided.tolist()
            for contact in (c for contacts in state.contacts for c in contacts):
                assert isinstance(contact, Contact)
                assert contact.links == tuple(sorted(contact.links))
                assert frozenset(contact.links) in robot.collision_pairs
                assert 0.0 <= contact.depth < np.inf

    def test_parameters_are_drawn_from_each_arms_seed(self, make: Make) -> None:
        backend = make(3)
        every, second = np.ones(3, np.bool_), np.array([False, True, False])
        drawn = []
        for seeds, mask in (([1, 2, 3], every), ([7, 7, 7], second), ([1, 2, 3], second)):
            backend.begin_episodes(np.array(seeds, np.uint64), mask)
            _reset(backend)
            drawn.append(copy.deepcopy(backend.state.parameters))
        assert (drawn[0] is not None) == backend.random
        first, other, again = (parameters or {} for parameters in drawn)
        for name, values in first.items():
            assert (values[0] != values[1]).any(), name
            assert (values[1] != other[name][1]).any(), name
            np.testing.assert_array_equal(values[~second], other[name][~second])
            np.testing.assert_array_equal(values, again[name])

    @pytest.mark.parametrize("count", [3, 40])
    def test_an_arm_does_not_depend_on_the_others(self, make: Make, count: int) -> None:
        together = make(count)
        q, joints = _reset(together), together.robot.num_joints
        # Some joints rest, so that the paths of the arms differ in length.
        rng = np.random.default_rng(3)
        rests = rng.random((6, count, joints)) < rng.random((6, count, 1))
        moves = uniform_q(together.robot, 6 * count, seed=3, furthest=2.3)
        targets = np.where(rests, q, moves.reshape(rests.shape))
        states = [together.step(target) for target in targets]
        for arm in range(0, count, max(1, count // 8)):
            one = slice(arm, arm + 1)
            alone = make(1)
            alone.reset(q[one])
            for state, target in zip(states, targets, strict=True):
                assert_same_state(arms_of(state, one), alone.step(target[one]), atol=1e-12)

    def test_from_a_snapshot_it_continues_identically(self, make: Make) -> None:
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

    def test_a_snapshot_taken_right_after_a_reset_is_complete(
        self, make: Make, robot: RobotModel
    ) -> None:
        backend = make(2)
        backend.reset(np.array([colliding_q(robot), robot.home]))
        snapshot = backend.save()
        _run(backend, 2)
        backend.restore(snapshot)
        assert backend.state.collided.tolist() == [True, False]
        assert not backend.state.time.any()

    def test_a_snapshot_pickles_and_fits_another_backend_made_alike(self, make: Make) -> None:
        backend, other = make(3), make(3)
        backend.begin_episodes(np.arange(3, dtype=np.uint64), np.ones(3, np.bool_))
        _reset(backend)
        _run(backend, 3)
        other.restore(pickled(backend.save()))
        _assert_same_run(backend, other)

    @pytest.mark.parametrize("duplicate", COPIES)
    def test_a_copy_continues_identically_and_independently(
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

    def test_equal_backends_compute_equal_states(self, make: Make) -> None:
        backend, other = make(3), make(3)
        _reset(backend)
        _reset(other)
        _assert_same_run(backend, other)

    def test_joints_stay_within_their_limits_where_targets_are_at_them(self, make: Make) -> None:
        backend = make(2)
        robot, overshoot = backend.robot, backend.overshoot
        backend.reset(np.array([robot.lower, robot.upper]))
        for _ in range(5):
            state = backend.step(np.array([robot.upper, robot.lower]))
            assert (state.q >= robot.lower - overshoot).all()
            assert (state.q <= robot.upper + overshoot).all()

    def test_a_state_outlives_its_backend(self, make: Make) -> None:
        backend = make(1)
        _reset(backend)
        (state,) = _run(backend, 1)
        kept = copy.deepcopy(state)
        backend.close()
        assert_same_state(state, kept)
