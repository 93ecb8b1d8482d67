"""The kinematic backend: joints that teleport, and joints that travel along a path checked for collisions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_mara.backends import make_backend
from gym_mara.backends.pinocchio import PinocchioBackend
from gym_mara.backends.servo_motion import servo_motion
from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.testing import COLLIDING_Q, assert_same_state, uniform_q
from gym_mara.types import Floats, Mask
from tests.helpers import PATH_ENDS, joint_xml, robot_model, urdf_xml, write

VELOCITY, PERIOD = 0.5, 0.02
TRAVEL = VELOCITY * PERIOD


def _backend(num_envs: int = 1, **settings: Any) -> PinocchioBackend:
    """A backend of a MARA whose joints may be as fast as a test wants."""
    return PinocchioBackend(robot_model("mara", velocity_limit=10.0), num_envs, **settings)


def _travelled(start: Floats, target: Floats, travel: float) -> Floats:
    """Where joints of equal velocity are when each has moved at most this far."""
    return start + np.clip(target - start, -travel, travel)


def test_by_default_the_joints_reach_their_targets_in_one_step_and_rest() -> None:
    backend = _backend(3)
    backend.reset(np.zeros((3, 6)))
    target = uniform_q(backend.robot, 3, 0)
    state = backend.step(target)
    np.testing.assert_array_equal(state.q, target)
    assert not state.qd.any()
    assert not state.ee_velocity.any()


def test_a_teleport_does_not_collide_between_its_ends() -> None:
    backend = _backend()
    backend.reset(np.array([PATH_ENDS[0]]))
    assert not backend.step(np.array([PATH_ENDS[1]])).collided[0]


def test_a_teleport_collides_where_the_checker_says() -> None:
    q = uniform_q(robot_model("mara"), 40, 1)
    backend = _backend(40)
    backend.reset(np.zeros((40, 6)))
    expected = make_checker("fcl", robot_model("mara")).check(q)
    np.testing.assert_array_equal(backend.step(q).collided, expected)


def test_joints_move_at_the_given_velocity_and_arrive_exactly() -> None:
    backend = _backend(max_joint_velocity=VELOCITY)
    backend.reset(np.zeros((1, 6)))
    target = np.array([[-0.0333, 0.0001, 0.02, 0.0, -0.015, 0.105]])
    for number in range(1, 12):
        state = backend.step(target)
        assert not state.collided[0]
        np.testing.assert_allclose(
            state.q, _travelled(np.zeros(6), target, number * TRAVEL), rtol=0.0, atol=1e-12
        )
        left = np.abs(target) - number * TRAVEL
        moving, arrived = left > 1e-9, left < 1e-9
        np.testing.assert_array_equal(state.qd[moving], (np.sign(target) * VELOCITY)[moving])
        np.testing.assert_array_equal(state.q[arrived], target[arrived])
        assert not state.qd[arrived].any()
    np.testing.assert_array_equal(state.q, target)
    assert not state.ee_velocity.any()


def test_no_joint_is_faster_than_its_own_limit() -> None:
    limits = (0.5, 1.57, 0.3, 1.0, 0.1, 1.57)
    robot = RobotModel.load("mara", velocity_limit=limits)
    backend = PinocchioBackend(robot, 1, max_joint_velocity=1.0)
    fastest = np.minimum(1.0, limits)
    np.testing.assert_array_equal(backend.joint_velocity, fastest)
    backend.reset(np.zeros((1, 6)))
    direction = np.array([1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
    for number in range(1, 4):
        state = backend.step(0.3 * direction[None])
        np.testing.assert_allclose(state.q[0], number * PERIOD * fastest * direction, atol=1e-12)
        np.testing.assert_array_equal(state.qd[0], fastest * direction)


def test_a_joint_without_velocity_can_teleport_and_not_travel(tmp_path: Path) -> None:
    still = joint_xml(1, limit='<limit lower="-2" upper="1.5" effort="10" velocity="0"/>')
    path = write(tmp_path / "arm.urdf", urdf_xml(joint_xml(0), still))
    robot = RobotModel.inspect(path, "link2")
    assert PinocchioBackend(robot, 1).step(np.ones((1, 2))).q.tolist() == [[1.0, 1.0]]
    with pytest.raises(GymMaraError, match=r"joint joint1 of stick .*limit is 0.*velocity_limit"):
        PinocchioBackend(robot, 1, max_joint_velocity=1.0)
    mended = RobotModel.load(path, "link2", velocity_limit={"joint1": 0.5})
    backend = PinocchioBackend(mended, 1, max_joint_velocity=1.0)
    np.testing.assert_array_equal(backend.joint_velocity, [1.0, 0.5])


def test_the_velocity_of_the_tool_is_the_derivative_of_its_position() -> None:
    backend = _backend(20, max_joint_velocity=1.0, control_period=1e-5)
    start, target = uniform_q(backend.robot, 20, 2), uniform_q(backend.robot, 20, 3)
    backend.reset(start)
    before = backend.state
    free = ~before.collided
    assert free.any()
    states = [before, backend.step(target), backend.step(target)]
    change = (states[2].ee_position - states[0].ee_position) / 2e-5
    np.testing.assert_allclose(states[1].ee_velocity[free], change[free], atol=1e-6)
    assert (np.linalg.norm(states[1].ee_velocity[free], axis=1) > 1e-3).all()


def test_a_path_that_collides_between_its_free_ends_stops_at_the_contact() -> None:
    start, target = np.array(PATH_ENDS)
    # The whole path in one period.
    backend = _backend(max_joint_velocity=10.0, control_period=1.0)
    backend.reset(start[None])
    assert not backend.state.collided[0]
    state = backend.step(target[None])
    assert state.collided.tolist() == [True]
    assert state.time.tolist() == [1.0]
    fine = np.tile(start, (4801, 1))
    fine[:, 3] = np.linspace(start[3], target[3], 4801)
    hits = make_checker("coal", backend.robot).check(fine)
    assert not hits[0]
    assert not hits[-1]
    contact = fine[hits.argmax(), 3]
    between_checks = backend.path_resolution / backend.robot.reach[3]
    assert contact - 0.001 <= state.q[0, 3] <= contact + between_checks
    np.testing.assert_array_equal(np.delete(state.q[0], 3), np.delete(start, 3))
    assert make_checker("fcl", backend.robot).check(state.q).tolist() == [True]


@given(st.integers(0, 2**32 - 1))
def test_an_arm_stops_at_the_first_contact_on_its_path(seed: int) -> None:
    backend = _backend(max_joint_velocity=10.0, control_period=1.0)
    checker = make_checker("coal", backend.robot)
    free = uniform_q(backend.robot, 20, seed)
    start, target = free[~checker.check(free)][:2]
    travels = np.linspace(0.0, np.abs(target - start).max(), 1500)
    hits = checker.check(np.array([_travelled(start, target, travel) for travel in travels]))
    backend.reset(start[None])
    state = backend.step(target[None])
    if not state.collided[0]:
        np.testing.assert_array_equal(state.q[0], target)
        # A contact shorter than the distance between two checks may be missed.
        depth = hits.sum() * (travels[1] - travels[0]) * backend.robot.reach.sum()
        assert depth <= backend.path_resolution + 2 * travels[1] * backend.robot.reach.sum()
        return
    assert checker.check(state.q)[0]
    travelled = np.abs(state.q[0] - start).max()
    np.testing.assert_allclose(
        state.q[0], _travelled(start, target, travelled), rtol=0.0, atol=1e-12
    )
    before = hits[travels < travelled - travels[1]]
    assert before.sum() * travels[1] * backend.robot.reach.min() <= backend.path_resolution


def test_one_arm_stops_and_the_others_continue() -> None:
    backend = _backend(2, max_joint_velocity=10.0, control_period=1.0)
    backend.reset(np.array([PATH_ENDS[0], PATH_ENDS[0]]))
    target = np.array([PATH_ENDS[1], np.zeros(6)])
    state = backend.step(target)
    assert state.collided.tolist() == [True, False]
    np.testing.assert_array_equal(state.q[1], np.zeros(6))
    assert not state.qd[1].any()
    assert (state.q[0] != target[0]).any()


def test_a_finer_path_resolution_stops_nearer_to_the_contact() -> None:
    stops = []
    for resolution in (0.2, 0.02, 0.002):
        backend = _backend(max_joint_velocity=10.0, control_period=1.0, path_resolution=resolution)
        backend.reset(np.array([PATH_ENDS[0]]))
        state = backend.step(np.array([PATH_ENDS[1]]))
        assert state.collided[0]
        stops.append(state.q[0, 3])
    assert stops[0] >= stops[1] >= stops[2]
    assert stops[0] > stops[2]


def test_an_arm_in_contact_can_move_back() -> None:
    backend = _backend(max_joint_velocity=10.0, control_period=1.0)
    backend.reset(np.array([PATH_ENDS[0]]))
    backend.step(np.array([PATH_ENDS[1]]))
    state = backend.step(np.array([PATH_ENDS[0]]))
    assert state.collided.tolist() == [False]
    np.testing.assert_array_equal(state.q[0], PATH_ENDS[0])


def test_without_a_checker_nothing_collides() -> None:
    backend = _backend(collision="none")
    assert not backend.step(np.array([COLLIDING_Q])).collided[0]


@pytest.mark.parametrize("name", ["mara", "ur5", "panda"])
def test_checking_the_middle_of_a_path_with_a_margin_changes_no_result(name: str) -> None:
    robot, rng = robot_model(name), np.random.default_rng(0)
    backend, sampling = (PinocchioBackend(robot, 32, max_joint_velocity=1.57) for _ in range(2))
    sampling._with_margin = None
    counts = [_count_checks(each) for each in (backend, sampling)]
    hits = 0
    for period in range(60):
        if period % 20 == 0:
            start, target = uniform_q(robot, 32, period), uniform_q(robot, 32, period + 1)
            for each in (backend, sampling):
                each.reset(start)
        if period % 20 == 15:  # short paths
            target = backend.state.q + rng.uniform(-0.01, 0.01, target.shape)
            target = target.clip(robot.lower, robot.upper)
        state = backend.step(target)
        assert_same_state(state, sampling.step(target))
        hits += int(state.collided.sum())
    assert 0 < hits < 60 * 32
    assert sum(counts[0]) < 0.7 * sum(counts[1]), "fewer exact checks"


def _count_checks(backend: PinocchioBackend) -> list[int]:
    """The number of configurations that the backend's exact checker checks, call by call."""
    counts, check = [], backend._checker.check

    def counted(q: Floats) -> Mask:
        counts.append(len(q))
        return check(q)

    backend._checker.check = counted  # type: ignore[method-assign]
    return counts


def test_a_snapshot_without_collisions_is_restored() -> None:
    # 0.2.0 saved none right after a reset; checkpoints of its runs have them.
    backend = PinocchioBackend(robot_model("mara"), 2)
    backend.reset(np.array([COLLIDING_Q, np.zeros(6)]))
    snapshot = backend.save() | {"collided": None}
    backend.step(np.zeros((2, 6)))
    backend.restore(snapshot)
    assert backend.state.collided.tolist() == [True, False]


@pytest.mark.parametrize("name", ["ur5", "panda"])
def test_other_robots_travel_too(name: str) -> None:
    robot: RobotModel = robot_model(name)
    backend = PinocchioBackend(robot, 1, max_joint_velocity=1.0, control_period=0.01)
    start = robot.home[None]
    backend.reset(start)
    state = backend.step(np.clip(start + 0.5, robot.lower, robot.upper))
    assert np.abs(state.q - start).max() == pytest.approx(0.01)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"max_joint_velocity": 0}, r"max_joint_velocity must be finite and positive .*not 0"),
        ({"max_joint_velocity": -1}, r"max_joint_velocity must be finite and positive.*not -1"),
        (
            {"max_joint_velocity": np.nan},
            r"max_joint_velocity must be finite and positive.*not nan",
        ),
        (
            {"max_joint_velocity": np.inf},
            r"max_joint_velocity must be finite and positive.*not inf",
        ),
        ({"path_resolution": 0.0}, r"path_resolution must be finite and positive \(m\), not 0.0"),
        (
            {"path_resolution": np.nan},
            r"path_resolution must be finite and positive \(m\), not nan",
        ),
        ({"path_resolution": -1.0}, r"path_resolution must be finite and positive \(m\), not -1.0"),
        ({"control_period": 0.0}, r"control_period must be finite and positive \(s\), not 0.0"),
        ({"collision": "bullet"}, r"unknown collision engine 'bullet'\..*coal, fcl"),
    ],
)
def test_settings_out_of_their_range(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        _backend(**settings)


# Joints with the law of a servo.


def test_joints_with_servos_follow_the_law_exactly() -> None:
    backend = _backend(20, servo_gain=10.0, max_joint_velocity=1.0, collision="none")
    q, target = uniform_q(backend.robot, 20, 2), uniform_q(backend.robot, 20, 3)
    target[:10] = q[:10] + 0.02 * target[:10]  # near their targets, they approach exponentially
    backend.reset(q)
    assert not backend.teleports
    gain, limit = np.array(10.0), np.ones(6)
    for number in range(1, 40):
        state = backend.step(target)
        expected = q + servo_motion(q, target, gain, limit, np.array(number * PERIOD))
        np.testing.assert_allclose(state.q, expected, rtol=0.0, atol=1e-12)
        law = np.clip(10.0 * (target - state.q), -1.0, 1.0)
        np.testing.assert_allclose(state.qd, law, rtol=0.0, atol=1e-12)


def test_without_max_joint_velocity_servos_have_the_limits_of_the_robot() -> None:
    robot = RobotModel.load("mara", velocity_limit=(0.5, 1.57, 0.3, 1.0, 0.1, 1.57))
    backend = PinocchioBackend(robot, 1, servo_gain=10.0)
    backend.reset(np.zeros((1, 6)))
    state = backend.step(np.ones((1, 6)))
    np.testing.assert_allclose(state.q[0], robot.velocity_limit * PERIOD, rtol=1e-12)
    np.testing.assert_array_equal(state.qd[0], robot.velocity_limit)


@pytest.mark.parametrize("period", [1.0, PERIOD])
def test_a_servos_path_that_collides_between_its_free_ends_stops_at_the_contact(
    period: float,
) -> None:
    start, target = np.array(PATH_ENDS)
    backend = _backend(servo_gain=10.0, max_joint_velocity=10.0, control_period=period)
    backend.reset(start[None])
    for _ in range(100):
        state = backend.step(target[None])
        if state.collided[0]:
            break
    # The tool collides from -1.15 rad on, and may be `path_resolution` further.
    assert state.q[0, 3] == pytest.approx(-1.15, abs=0.1)
    assert not state.qd.any()
    free = state.q - 0.1 * (target - start) / np.abs(target - start).max()
    assert not make_checker("coal", backend.robot).check(free).any()


@pytest.mark.parametrize("name", ["dart", "mujoco"])
def test_one_action_moves_the_arm_as_with_dynamics(name: str) -> None:
    """Motors take a moment to reach their velocity: they lag by less than 3 mrad for targets within 50 mrad."""
    mara = robot_model("mara")
    dynamic = make_backend(name, mara, 8, {"servo_gain": 10.0})
    kinematic = PinocchioBackend(mara, 8, servo_gain=10.0)
    q = uniform_q(mara, 8, 0, furthest=0.6)
    target = q + uniform_q(mara, 8, 1, furthest=0.05)
    for backend in (dynamic, kinematic):
        backend.reset(q)
    for _ in range(50):
        state, expected = dynamic.step(target), kinematic.step(target)
        assert not expected.collided.any()
        np.testing.assert_allclose(state.q, expected.q, rtol=0.0, atol=3e-3)
    np.testing.assert_allclose(state.q, expected.q, rtol=0.0, atol=1e-4)
    dynamic.close()


@pytest.mark.parametrize("gain", [0.0, -1.0, np.nan, "10", True])
def test_a_wrong_gain_is_refused(gain: Any) -> None:
    with pytest.raises(GymMaraError, match="servo_gain must be finite and positive"):
        _backend(servo_gain=gain)
