"""Limits of motions, set-points within them, and the stops from each set-point."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_mara.errors import GymMaraError, MissingExtraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.safety.motion import (
    ACCELERATION_TIME,
    VELOCITY_TIME,
    Motion,
    MotionLimits,
)
from gym_mara.ros2.safety.planners import NoTrajectoryError
from tests.helpers import Floats, joint_xml, robot_model, urdf_xml, write

PERIOD = 0.01


def test_the_limits_of_a_robot_follow_from_its_velocities(mara: RobotModel) -> None:
    limits = MotionLimits.of(mara)
    np.testing.assert_array_equal(limits.velocity, mara.velocity_limit)
    np.testing.assert_allclose(limits.acceleration, mara.velocity_limit / VELOCITY_TIME)
    np.testing.assert_allclose(limits.jerk, limits.acceleration / ACCELERATION_TIME)
    slow = MotionLimits.of(mara, 0.5, max_joint_acceleration=2.0)
    np.testing.assert_array_equal(slow.velocity, 0.5)
    np.testing.assert_array_equal(slow.acceleration, 2.0)
    np.testing.assert_allclose(slow.jerk, 2.0 / ACCELERATION_TIME)
    np.testing.assert_array_equal(MotionLimits.of(mara, max_joint_jerk=7).jerk, 7.0)
    with pytest.raises(ValueError, match="read-only"):
        limits.velocity[0] = 100.0


@pytest.mark.parametrize("name", ["max_joint_velocity", "max_joint_acceleration", "max_joint_jerk"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, "fast", True])
def test_a_limit_that_is_no_positive_number_is_an_error(
    mara: RobotModel, name: str, value: Any
) -> None:
    with pytest.raises(GymMaraError, match=name):
        MotionLimits.of(mara, **{name: value})


def test_limits_of_different_sizes_are_an_error() -> None:
    with pytest.raises(GymMaraError, match="jerk must be a list of 2 finite numbers"):
        MotionLimits(np.ones(2), np.ones(2), np.ones(3))
    with pytest.raises(GymMaraError, match="acceleration must be finite and positive"):
        MotionLimits(np.ones(2), np.array([1.0, -1.0]), np.ones(2))


def test_a_joint_without_a_velocity_limit_needs_one(tmp_path: Path) -> None:
    xml = urdf_xml(joint_xml(0), joint_xml(1, "continuous", limit=""))
    robot = RobotModel.load(write(tmp_path / "a.urdf", xml), "link2")
    with pytest.raises(GymMaraError, match=r"joint1 of \S+ has no velocity limit.*max_joint_velo"):
        MotionLimits.of(robot)
    np.testing.assert_array_equal(MotionLimits.of(robot, 1.5).velocity, [1.5, 1.5])


def _motion(robot: RobotModel, infinite: bool = False) -> Motion:
    low, high = robot.lower, robot.upper
    if infinite:
        low, high = np.full_like(low, -np.inf), np.full_like(high, np.inf)
    return Motion(MotionLimits.of(robot), low, high, PERIOD)


@pytest.mark.parametrize("name", ["mara", "panda"])
@pytest.mark.parametrize("infinite", [False, True])
@settings(max_examples=10)
@given(seed=st.integers(0, 2**32 - 1))
def test_every_stop_is_known_from_its_start_to_its_end(
    name: str, infinite: bool, seed: int
) -> None:
    robot, rng = robot_model(name), np.random.default_rng(seed)
    motion = _motion(robot, infinite)
    motion.rest_at(robot.home.tolist())
    for _ in range(20):
        wide = rng.uniform(robot.lower - 1.0, robot.upper + 1.0)
        target, share = motion.clip(wide.tolist()), float(rng.uniform(0.05, 1.0))
        for _ in range(rng.integers(1, 12)):
            assert motion.propose(target, share), "a reachable target never leaves the limits"
            times = np.linspace(0.0, motion.stop_duration, 50)
            states = np.array([motion.proposed(time) for time in times])
            low, high = np.array(motion.extremes).T
            assert (states[:, 0] >= low - 1e-9).all()
            assert (states[:, 0] <= high + 1e-9).all()
            np.testing.assert_allclose(states[-1, 1:], 0.0, atol=1e-9)
            before = motion.proposed(-PERIOD)
            np.testing.assert_allclose(before, [motion.q, motion.qd, motion.qdd], atol=1e-9)
            motion.accept()


def test_the_way_from_rest_to_a_constant_target_is_straight(mara: RobotModel) -> None:
    motion, target = _motion(mara), np.array([0.5, -0.4, 0.9, 1.0, -0.2, 0.01])
    motion.rest_at([0.0] * 6)
    path: list[Floats] = []
    for tick in range(400):
        motion.propose(target.tolist(), min(1.0, 0.1 + 0.009 * tick))
        motion.accept()
        path.append(np.array(motion.q))
        if motion.resting:
            break
    np.testing.assert_array_equal(path[-1], target)
    part = np.array(path) @ target / (target @ target)
    assert (np.diff(part) >= 0.0).all()
    np.testing.assert_allclose(np.array(path), part[:, None] * target, atol=1e-9)


@pytest.mark.parametrize(
    ("way", "share", "least"), [(1.5, 1.0, 0.99), (0.5, 0.25, 0.99), (1e-3, 1.0, 0)]
)
def test_the_time_of_a_way_is_known(
    mara: RobotModel, way: float, share: float, least: float
) -> None:
    motion, limits = _motion(mara), MotionLimits.of(mara)
    q = np.array(motion.q)
    target = q + way * np.array([1.0, -0.5, 0.2, 0.0, 0.7, -0.9])
    ticks = 0
    while not (ticks and motion.resting):
        assert motion.propose(target.tolist(), share)
        motion.accept()
        ticks += 1
    known = limits.duration(target - q, share)
    assert least * known < ticks * PERIOD < known + 2.0 * PERIOD
    assert limits.duration(0.0 * q) == 0.0


def test_a_stop_is_followed_to_its_end_and_no_further(mara: RobotModel) -> None:
    motion = _motion(mara)
    for _ in range(30):
        assert motion.propose([1.0] * 6, 1.0)
        motion.accept()
    assert motion.qd[0] > 0.5
    while not motion.follow_stop():
        assert not motion.resting
    assert motion.resting
    end = list(motion.q)
    assert motion.qd == motion.qdd == [0.0] * 6
    assert motion.follow_stop()
    assert motion.q == end


@pytest.mark.parametrize("turns", [True, False])
def test_a_stop_can_be_left_and_begun_again(mara: RobotModel, turns: bool) -> None:
    motion, rng = _motion(mara), np.random.default_rng(4)
    last = [motion.q, motion.qd, motion.qdd]
    for _ in range(200):
        if rng.random() < 0.3:
            motion.follow_stop()
        else:
            target = rng.choice([-1.0, 1.0], 6) if turns else np.full(6, 1.5)
            assert motion.propose(target.tolist(), 1.0)
            motion.accept()
        now = [motion.q, motion.qd, motion.qdd]
        jerk = (np.array(now[2]) - last[2]) / PERIOD
        assert (np.abs(jerk) <= np.array(motion.jerk) * (1.0 + 1e-6)).all()
        mean = 0.5 * PERIOD * (np.array(now[1]) + last[1])
        np.testing.assert_allclose(np.array(now[0]) - last[0], mean, rtol=0.0, atol=2e-5)
        last = now


def test_a_joint_without_limits_turns_on_and_on() -> None:
    motion = _motion(robot_model("mara"), infinite=True)
    for _ in range(2000):
        assert motion.propose([1e6, -1e12, 0.0, 0.0, 0.0, 1e300], 1.0)
        motion.accept()
    assert motion.q[0] > 10.0
    assert motion.q[1] < -10.0
    assert motion.q[5] > 10.0


@pytest.mark.parametrize("way", [1e-300, 1e-17, 1e-12, 1e-9, 1e-6])
def test_the_smallest_way_is_a_way(mara: RobotModel, way: float) -> None:
    motion = _motion(mara)
    for target in ([way] * 6, [0.0, way, 0.0, 0.0, 0.0, 0.0]):
        for _ in range(100):
            assert motion.propose(target, 1.0)
            motion.accept()
        assert motion.resting
        assert motion.q == target
    assert motion.propose(motion.q, 1.0)
    motion.accept()
    assert motion.q == target


def test_a_target_that_is_no_number_has_no_trajectory(mara: RobotModel) -> None:
    motion = _motion(mara)
    with pytest.raises(NoTrajectoryError, match="Ruckig finds no trajectory"):
        motion.propose([np.nan] * 6, 1.0)


def test_without_ruckig_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ruckig", None)
    monkeypatch.delitem(sys.modules, "gym_mara.ros2.safety.planners")
    with pytest.raises(MissingExtraError, match=r"safety filter needs ruckig.*gym_mara\[ros2\]"):
        import gym_mara.ros2.safety.planners  # noqa: F401
