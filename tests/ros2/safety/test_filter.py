"""The safety filter: whatever it is given, the arm stays within its limits, touches nothing, and can stop."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pytest

from gym_mara.collision import CollisionChecker, make_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.safety.filter import RAMP_START, Mode
from gym_mara.testing import COLLIDING_Q
from tests.helpers import PATH_ENDS, Floats, Mask, joint_xml, urdf_xml, write
from tests.ros2.safety.arms import PERIOD, Arm, in_motion, state_of


def test_a_reachable_command_is_reached_exactly_and_held(mara: RobotModel) -> None:
    arm, target = Arm(mara, make_checker("coal", mara)), mara.home + 0.3
    arm.is_in(Mode.WAITING)
    setpoints = arm.ticks(target, 200)
    arm.is_in(Mode.MOVING)
    for setpoint in setpoints[-20:]:
        np.testing.assert_array_equal(setpoint.q, target)
        assert not setpoint.qd.any()
        assert not setpoint.qdd.any()


def test_the_speed_rises_on_a_ramp(mara: RobotModel) -> None:
    arm = Arm(mara)
    speeds = [np.abs(s.qd).max() for s in arm.ticks(mara.home + 2.0, 120)] / mara.velocity_limit[0]
    ramp = RAMP_START + (1.0 - RAMP_START) * PERIOD * np.arange(120)
    assert (speeds <= ramp + 1e-9).all()
    assert speeds.max() > 0.99
    arm.filter.stop("a break")
    arm.until_stopped()
    arm.resume()
    again = [np.abs(s.qd).max() for s in arm.ticks(mara.home - 1.0, 50)] / mara.velocity_limit[0]
    assert (again <= ramp[:50] + 1e-9).all(), "a resume begins on the ramp as well"


def test_the_speed_can_be_lowered_on_the_way(mara: RobotModel) -> None:
    arm = in_motion(mara)
    arm.filter.speed = 0.2
    speeds = [np.abs(s.qd).max() for s in arm.ticks(mara.home + 2.0, 60)]
    assert speeds[0] <= mara.velocity_limit[0]
    assert speeds[-1] == pytest.approx(0.2 * mara.velocity_limit[0])
    for wrong in (0.0, 1.5, np.nan, -0.1, "slow", 0.001):
        with pytest.raises(GymMaraError, match="speed must be"):
            arm.filter.speed = wrong  # type: ignore[assignment]
    assert arm.filter.speed == 0.2


def test_before_the_first_command_the_arm_holds(mara: RobotModel) -> None:
    arm = Arm(mara)
    for setpoint in arm.ticks(None, 100, commanded=np.nan):
        np.testing.assert_array_equal(setpoint.q, mara.home)
    assert arm.filter.mode is Mode.WAITING
    old = arm.ticks(mara.home + 1.0, 20, commanded=9.9)
    assert arm.filter.mode is Mode.WAITING, "it was commanded before the start"
    np.testing.assert_array_equal(old[-1].q, mara.home)


def test_before_the_first_command_no_state_is_needed(mara: RobotModel) -> None:
    arm = Arm(mara)
    arm.ticks(None, 100, state=None)
    arm.is_in(Mode.WAITING)
    arm.tick(mara.home + 0.1, state=None)
    assert arm.filter.reason == "the arm reports no state"


def test_an_arm_that_rests_at_its_target_needs_no_new_command(mara: RobotModel) -> None:
    arm, target = Arm(mara), mara.home + 0.3
    arm.ticks(target, 200)
    commanded = arm.now
    held = arm.ticks(target, 300, commanded=commanded)
    arm.is_in(Mode.MOVING)
    np.testing.assert_array_equal(held[-1].q, target)
    arm.ticks(target - 0.3, 20, commanded=commanded)
    assert "the command is" in (arm.filter.reason or ""), "an old command moves nothing"


def test_a_command_beyond_the_limits_is_cut_to_them(mara: RobotModel) -> None:
    arm = Arm(mara)
    target = np.array([mara.upper[0] + 1.0, *mara.home[1:]])
    for _ in range(300):
        setpoint = arm.tick(target, commanded=10.0 + 0.1 * (int(arm.now * 100) // 10 - 100))
    assert arm.filter.mode is Mode.MOVING
    assert setpoint.q[0] == mara.upper[0]
    assert 25 <= arm.filter.clipped <= 35, "a command counts once, not at every tick"


def test_a_stop_is_one_and_keeps_its_first_reason(mara: RobotModel) -> None:
    arm = in_motion(mara)
    arm.filter.stop("the operator's wish")
    assert arm.filter.mode is Mode.STOPPING
    arm.filter.stop("another")
    arm.tick(np.full(6, np.nan), state=None)
    assert arm.filter.reason == "the operator's wish"
    with pytest.raises(GymMaraError, match="the arm still decelerates"):
        arm.resume()
    arm.until_stopped(mara.home)
    arm.resume()
    with pytest.raises(GymMaraError, match="there is no stop to resume from: the arm is waiting"):
        arm.resume()


def test_a_stop_by_somebody_counts_more_than_a_collision_ahead(mara: RobotModel) -> None:
    arm = Arm(mara, make_checker("coal", mara), q=np.array(PATH_ENDS[0]))
    while not arm.filter.blocked:
        arm.tick(np.array(PATH_ENDS[1]))
    assert "collision ahead" in (arm.filter.reason or "")
    arm.filter.stop("the operator's wish")
    assert (arm.filter.reason, arm.filter.blocked) == ("the operator's wish", False)
    arm.until_stopped()
    arm.resume()
    arm.filter.stop("again")
    assert not arm.filter.blocked


def test_it_resumes_from_the_measured_pose(mara: RobotModel) -> None:
    arm = in_motion(mara)
    arm.filter.stop("a push")
    arm.until_stopped()
    pushed = arm.q + 0.3
    arm.filter.resume(state_of(pushed, arm.now), arm.now)
    arm.q = pushed
    np.testing.assert_array_equal(arm.tick(None).q, pushed)
    assert np.abs(arm.tick(mara.home).q - pushed).max() < 1e-3


def test_a_command_in_an_obstacle_stops_the_arm_before_it(mara: RobotModel) -> None:
    checker = make_checker("coal", mara)
    arm = Arm(mara, checker)
    for _ in range(400):
        arm.tick(np.array(COLLIDING_Q))
        assert not checker.check(arm.q[None])[0]
    assert arm.filter.mode is Mode.STOPPED
    assert arm.filter.reason is not None
    assert arm.filter.reason.startswith("collision ahead: ")
    links = arm.filter.reason.removeprefix("collision ahead: ").replace(" and ", ", ").split(", ")
    assert len(links) > 1
    assert {link for pair in mara.collision_pairs for link in pair} >= set(links)
    arm.resume()  # where it stopped it is free
    arm.ticks(mara.home, 400)
    np.testing.assert_array_equal(arm.q, mara.home)


def test_a_collision_on_the_way_to_a_free_target_stops_the_arm(mara: RobotModel) -> None:
    checker, (begin, end) = make_checker("coal", mara), map(np.array, PATH_ENDS)
    arm = Arm(mara, checker, q=begin)
    path = np.array([setpoint.q for setpoint in arm.ticks(end, 500)])
    assert arm.filter.mode is Mode.STOPPED
    assert arm.filter.reason is not None
    assert "collision ahead" in arm.filter.reason
    assert not checker.check(path).any()
    assert path[-1][3] > -2.0, "it gets on as far as it can"


class Failing(CollisionChecker):
    """An engine that fails once the arm moves."""

    def check(self, q: Floats) -> Mask:
        if (q == self.robot.home).all():
            return np.zeros(len(q), np.bool_)
        raise RuntimeError("out of memory")


def test_an_engine_that_fails_stops_the_arm(mara: RobotModel) -> None:
    arm = Arm(mara, Failing(mara))
    arm.tick(mara.home + 0.5)
    assert arm.filter.mode is Mode.STOPPED
    assert arm.filter.reason == "the safety filter failed: RuntimeError('out of memory')"


def test_a_stop_comes_from_any_thread(mara: RobotModel) -> None:
    arm = in_motion(mara)
    thread = threading.Thread(target=arm.filter.stop, args=("a service call",))
    thread.start()
    arm.ticks(mara.home + 1.5, 20)
    thread.join(5.0)
    arm.until_stopped()
    assert arm.filter.reason == "a service call"


def test_set_points_are_the_callers(mara: RobotModel) -> None:
    arm = in_motion(mara)
    before = arm.filter.setpoint
    assert before is not None
    for array in before:
        array[:] = np.nan
    assert np.isfinite(arm.filter.setpoint).all()  # type: ignore[arg-type]


def test_prismatic_and_continuous_joints_move_as_well(tmp_path: Path) -> None:
    turning = '<limit effort="10" velocity="2"/>'
    xml = urdf_xml(joint_xml(0, "continuous", limit=turning), joint_xml(1, "prismatic"))
    robot = RobotModel.load(write(tmp_path / "a.urdf", xml), "link2")
    arm, target = Arm(robot, make_checker("coal", robot)), np.array([2.0, -0.5])
    arm.ticks(target, 400)
    assert arm.filter.reason is None
    np.testing.assert_array_equal(arm.q, target)
