"""Where the safety filter starts and resumes, and its settings."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest

from gym_mara.collision import make_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.arm import ArmState
from gym_mara.ros2.safety.filter import Mode, SafetyFilter, Watchdogs
from gym_mara.ros2.safety.motion import MotionLimits
from gym_mara.testing import COLLIDING_Q
from tests.helpers import robot_model
from tests.ros2.safety.arms import PERIOD, Arm, state_of


def _refusals(mara: RobotModel) -> list[tuple[ArmState | None, str]]:
    home, moving = mara.home, np.array([0, 0, 0.3, 0, 0, 0])
    beyond = home.copy()
    beyond[1] = mara.upper[1] + 0.1
    return [
        (None, "the arm reports no state"),
        (state_of(home, 0.8), r"the arm's state is 0\.2 s old.*published"),
        (state_of(home, np.nan), "the arm's state has the time nan"),
        (state_of(home, 1.0, moving), r"the arm moves: motor3 at 0\.3 rad/s.*only at rest"),
        (state_of(home, 1.0, np.nan), "the arm's velocity is not finite"),
        (state_of(home * np.nan, 1.0), "the measured pose must be a list of"),
        (state_of(home[:4], 1.0, np.zeros(4)), "the arm's velocity has shape"),
        (state_of(home, 1.0)._replace(q=home[:4]), r"the measured pose has shape \(4,\)"),
        (state_of(beyond, 1.0), "the measured pose: joint motor2 cannot be at"),
        (
            state_of(np.array(COLLIDING_Q), 1.0),
            r"the arm collides at its measured pose: \w+.* and \w+",
        ),
    ]


def test_it_starts_only_from_a_good_measured_pose_at_rest(mara: RobotModel) -> None:
    safety = SafetyFilter(mara, PERIOD, MotionLimits.of(mara), checker=make_checker("coal", mara))
    with pytest.raises(GymMaraError, match="has not started: call start"):
        safety.step(1.0, state_of(mara.home, 1.0), mara.home, 1.0)
    for state, reason in _refusals(mara):
        with pytest.raises(GymMaraError, match=reason):
            safety.start(state, 1.0)
        assert safety.mode is Mode.WAITING
        assert safety.setpoint is None
    safety.start(state_of(mara.home, 1.0), 1.0)
    np.testing.assert_array_equal(safety.setpoint.q, mara.home)  # type: ignore[union-attr]
    with pytest.raises(GymMaraError, match="has started already"):
        safety.start(state_of(mara.home, 1.0), 1.0)


def test_it_resumes_only_from_a_good_measured_pose_at_rest(mara: RobotModel) -> None:
    safety = SafetyFilter(mara, PERIOD, MotionLimits.of(mara), checker=make_checker("coal", mara))
    safety.stop("before the start")
    for state, reason in _refusals(mara):
        with pytest.raises(GymMaraError, match=reason):
            safety.resume(state, 1.0)
        assert safety.mode is Mode.STOPPED
        assert safety.reason == "before the start"
    with pytest.raises(
        GymMaraError, match=r"stopped \(before the start\): an operator must resume"
    ):
        safety.start(state_of(mara.home, 1.0), 1.0)
    safety.resume(state_of(mara.home, 1.0), 1.0)
    assert safety.mode is Mode.WAITING


def test_a_joint_at_its_end_stop_may_be_measured_a_little_beyond(mara: RobotModel) -> None:
    q = mara.home.copy()
    q[1] = mara.upper[1] + 5e-4
    arm = Arm(mara, q=q)
    assert arm.tick(None).q[1] == mara.upper[1]


def test_an_arm_with_noisy_encoders_starts_and_resumes_with_a_larger_rest_velocity(
    mara: RobotModel,
) -> None:
    noisy = np.array([0.04, -0.03, 0.0, 0.02, -0.049, 0.01])
    limits = MotionLimits.of(mara)
    with pytest.raises(GymMaraError, match=r"at -0\.049 rad/s.*below 0\.02.*rest_velocity"):
        SafetyFilter(mara, PERIOD, limits).start(state_of(mara.home, 1.0, noisy), 1.0)
    safety = SafetyFilter(mara, PERIOD, limits, Watchdogs(rest_velocity=0.05))
    safety.start(state_of(mara.home, 1.0, noisy), 1.0)
    safety.stop("a test")
    safety.step(1.01, state_of(mara.home, 1.01, noisy), None, 1.0)
    assert safety.mode is Mode.STOPPED
    with pytest.raises(GymMaraError, match=r"0\.098 rad/s.*below 0\.05"):
        safety.resume(state_of(mara.home, 1.01, 2.0 * noisy), 1.01)
    safety.resume(state_of(mara.home, 1.01, noisy), 1.01)


def test_an_arm_that_was_moved_while_it_waited_starts_where_it_is(mara: RobotModel) -> None:
    arm = Arm(mara, make_checker("coal", mara))
    arm.ticks(None, 50)
    arm.q = measured = mara.home + 0.18
    path = np.array([measured, *(setpoint.q for setpoint in arm.ticks(mara.home, 200))])
    arm.is_in(Mode.MOVING)
    assert np.abs(path[1] - measured).max() < 1e-3
    assert (np.abs(np.diff(path, axis=0)) <= mara.velocity_limit * PERIOD + 1e-9).all()
    np.testing.assert_array_equal(path[-1], mara.home)


def test_an_arm_that_was_moved_far_while_it_waited_needs_an_operator(mara: RobotModel) -> None:
    arm = Arm(mara)
    arm.tick(None)
    arm.q = mara.home + 0.5
    arm.tick(mara.home, state=state_of(arm.q, arm.now + PERIOD))
    assert "the arm does not follow" in (arm.filter.reason or "")
    arm.filter.resume(state_of(mara.home + 0.5, arm.now), arm.now)
    setpoint = arm.tick(mara.home, state=state_of(mara.home + 0.5, arm.now))
    np.testing.assert_allclose(setpoint.q, mara.home + 0.5, atol=1e-3)


def test_an_arm_that_cannot_start_at_the_first_command_stays_where_it_is(mara: RobotModel) -> None:
    moving, colliding = np.array([0, 0, 0.3, 0, 0, 0]), np.array(COLLIDING_Q)
    for q, qd, reason in (
        (mara.home + 0.1, moving, r"the arm moves: motor3 at 0\.3 rad/s.*only at rest"),
        (mara.home, np.full(6, np.nan), "the arm's velocity is not finite"),
        (colliding, 0.0, r"the arm collides at its measured pose: \w+.* and \w+"),
        (mara.upper + 0.1, 0.0, "the measured pose: joint motor1 cannot be at"),
    ):
        arm = Arm(mara, make_checker("coal", mara), Watchdogs(tracking_error=10.0))
        arm.ticks(None, 50)
        arm.tick(mara.home + 0.2, state=state_of(q, arm.now + PERIOD, qd))
        arm.is_in(Mode.STOPPED)
        assert re.match(reason, arm.filter.reason or "")
        np.testing.assert_array_equal(arm.q, mara.home, "no set-point leads anywhere")


@pytest.mark.parametrize("field", ["state_age", "command_age", "tracking_error", "rest_velocity"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, None, True])
def test_a_watchdog_that_never_barks_is_an_error(field: str, value: Any) -> None:
    with pytest.raises(GymMaraError, match=f"{field} must be finite and positive"):
        Watchdogs(**{field: value})
    with pytest.raises(dataclasses.FrozenInstanceError):
        Watchdogs().state_age = 1.0  # type: ignore[misc]


def test_settings_that_do_not_fit_are_errors(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="period must be at most 1 "):
        SafetyFilter(mara, 2.0, MotionLimits.of(mara))
    with pytest.raises(GymMaraError, match="limits are of 7 joints, and mara has 6"):
        SafetyFilter(mara, PERIOD, MotionLimits.of(robot_model("panda")))
