"""The safety filter: whatever it is given, the arm stays within its limits, touches nothing, and can stop."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.collision import CollisionChecker, make_checker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.arm import ArmState, Setpoint
from gym_mara.ros2.motion import MotionLimits
from gym_mara.ros2.safety import RAMP_START, Mode, SafetyFilter, Watchdogs
from gym_mara.testing import COLLIDING_Q
from tests.helpers import PATH_ENDS, Floats, Mask, joint_xml, robot_model, urdf_xml, write

PERIOD = 0.01
LONGEST_STOP = 0.5
"""With the default limits every arm rests after less than this, s."""


def state_of(q: Floats, received: float, qd: Floats | float = 0.0) -> ArmState:
    """A state as an arm reports it."""
    return ArmState(q.copy(), np.broadcast_to(qd, q.shape).copy(), None, received, 0.0)


class Arm:
    """A filter and an arm that follows it exactly."""

    def __init__(
        self,
        robot: RobotModel,
        checker: CollisionChecker | None = None,
        watchdogs: Watchdogs | None = None,
        q: Floats | None = None,
    ) -> None:
        self.robot, self.now = robot, 10.0
        self.filter = SafetyFilter(
            robot, PERIOD, MotionLimits.of(robot), watchdogs or Watchdogs(), checker
        )
        self.q = robot.home if q is None else q
        self.filter.start(state_of(self.q, self.now), self.now)

    def tick(self, command: Any, **changes: Any) -> Setpoint:
        """A tick, with other arguments of `step` where they are given."""
        self.now += PERIOD
        fresh = {"now": self.now, "state": state_of(self.q, self.now), "commanded": self.now}
        setpoint = self.filter.step(command=command, **{**fresh, **changes})
        self.q = setpoint.q
        return setpoint

    def ticks(self, command: Any, count: int, **changes: Any) -> list[Setpoint]:
        """Several of them."""
        return [self.tick(command, **changes) for _ in range(count)]

    def until_stopped(self, command: Any = None) -> list[Setpoint]:
        """The set-points until the arm has stopped."""
        setpoints = []
        while self.filter.mode is not Mode.STOPPED:
            setpoints.append(self.tick(command))
            assert len(setpoints) * PERIOD < LONGEST_STOP
        return setpoints

    def is_in(self, mode: Mode) -> None:
        """Check the mode, and that there is a reason if it is a stop."""
        assert self.filter.mode is mode
        assert bool(self.filter.reason) == (mode in (Mode.STOPPING, Mode.STOPPED))

    def resume(self) -> None:
        """Resume where the arm is."""
        self.filter.resume(state_of(self.q, self.now), self.now)


def in_motion(robot: RobotModel, **arguments: Any) -> Arm:
    """An arm at full speed."""
    arm = Arm(robot, **arguments)
    arm.ticks(robot.home + 1.5, 130)
    assert np.abs(arm.filter.setpoint.qd).max() > 0.5  # type: ignore[union-attr]
    return arm


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


def test_a_command_beyond_the_limits_is_cut_to_them(mara: RobotModel) -> None:
    arm = Arm(mara)
    target = np.array([mara.upper[0] + 1.0, *mara.home[1:]])
    for _ in range(300):
        setpoint = arm.tick(target, commanded=10.0 + 0.1 * (int(arm.now * 100) // 10 - 100))
    assert arm.filter.mode is Mode.MOVING
    assert setpoint.q[0] == mara.upper[0]
    assert 25 <= arm.filter.clipped <= 35, "a command counts once, not at every tick"


NO_COMMANDS: dict[str, tuple[Any, str]] = {
    "nan": (
        np.array([0.0, np.nan, 0.0, 0.0, 0.0, 0.0]),
        "the command is not finite: nan for motor2",
    ),
    "inf": (np.array([np.inf] + [0.0] * 5), "the command is not finite: inf for motor1"),
    "short": (np.zeros(5), r"the command has shape \(5,\), not \(6,\)"),
    "batch": (np.zeros((1, 6)), r"the command has shape \(1, 6\)"),
    "number": (0.0, r"the command has shape \(\)"),
    "text": ("home", "the command is not made of real numbers"),
    "ragged": ([[0.0], 0.0], "the command is not made of real numbers"),
    "complex": (np.zeros(6, complex), "the command is not made of real numbers"),
    "object": ([None] * 6, "the command is not made of real numbers"),
    "none": (None, "the commands have ended"),
}


@pytest.mark.parametrize("name", NO_COMMANDS)
def test_what_is_no_command_stops_the_arm(mara: RobotModel, name: str) -> None:
    arm, (command, reason) = in_motion(mara), NO_COMMANDS[name]
    arm.tick(command)
    _stops(arm, reason)


TROUBLES: dict[str, tuple[dict[str, Callable[[Arm], Any]], str]] = {
    "no state": ({"state": lambda arm: None}, "the arm reports no state"),
    "old state": (
        {"state": lambda arm: state_of(arm.q, arm.now - 0.15)},
        r"the arm's state is 0\.16 s old, and 0\.1 s are allowed",
    ),
    "future state": (
        {"state": lambda arm: state_of(arm.q, arm.now + 5.0)},
        "state has the time 16",
    ),
    "timeless state": ({"state": lambda arm: state_of(arm.q, np.nan)}, "state has the time nan"),
    "nan in a state": (
        {"state": lambda arm: state_of(arm.q * np.nan, arm.now)},
        "is not finite: nan",
    ),
    "partial state": (
        {"state": lambda arm: state_of(arm.q[:3], arm.now)},
        r"state has shape \(3,\)",
    ),
    "not following": (
        {"state": lambda arm: state_of(arm.q - [0, 0, 0.25, 0, 0, 0], arm.now)},
        r"the arm does not follow: motor3 is 0\.2\d* rad \(m\) from its set-point, and 0\.2 are",
    ),
    "old command": (
        {"commanded": lambda arm: arm.now - 0.25},
        r"the command is 0\.26 s old, and 0\.2 s are allowed",
    ),
    "timeless command": ({"commanded": lambda arm: np.nan}, "the command has the time nan"),
    "clock stands": ({"now": lambda arm: arm.now}, "the clock stands still"),
    "clock back": ({"now": lambda arm: arm.now - 5.0}, r"the clock jumps from 11\.3 to 6\.3 s"),
    "no clock": ({"now": lambda arm: np.nan}, r"the clock jumps from 11\.3 to nan s"),
    "clock ahead": ({"now": lambda arm: arm.now + 5.0}, r"the arm's state is 4\.99 s old"),
    "broken state": ({"state": lambda arm: "no state"}, "the safety filter failed: AttributeError"),
}


@pytest.mark.parametrize("name", TROUBLES)
def test_trouble_stops_the_arm(mara: RobotModel, name: str) -> None:
    arm, (changes, reason) = in_motion(mara), TROUBLES[name]
    arm.tick(mara.home + 1.5, **{key: change(arm) for key, change in changes.items()})
    _stops(arm, reason)


def _stops(arm: Arm, reason: str) -> None:
    """Check that the arm decelerates for this reason, holds, and resumes from where it is."""
    arm.is_in(Mode.STOPPING)
    arm.until_stopped(arm.robot.home + 1.5)
    held = arm.q
    for setpoint in arm.ticks(arm.robot.home, 10):
        np.testing.assert_array_equal(setpoint.q, held)
        assert not setpoint.qd.any()
        assert not setpoint.qdd.any()
    arm.filter.stop("too late")
    assert arm.filter.reason is not None
    with pytest.raises(GymMaraError, match=reason):
        raise GymMaraError(arm.filter.reason)
    with pytest.raises(GymMaraError, match=r"is stopped .* an operator must resume"):
        arm.filter.start(state_of(arm.q, arm.now), arm.now)
    arm.resume()
    arm.is_in(Mode.WAITING)
    np.testing.assert_array_equal(arm.tick(arm.robot.home, commanded=arm.now - 0.05).q, held)
    assert np.abs(arm.tick(arm.robot.home).q - held).max() < 1e-3
    arm.is_in(Mode.MOVING)


def test_a_stop_is_one_and_keeps_its_first_reason(mara: RobotModel) -> None:
    arm = in_motion(mara)
    arm.filter.stop("the operator's wish")
    assert arm.filter.mode is Mode.STOPPING
    arm.filter.stop("another")
    arm.tick(np.full(6, np.nan), state=None)
    assert arm.filter.reason == "the operator's wish"
    with pytest.raises(GymMaraError, match="there is no stop to resume from: the arm is stopping"):
        arm.resume()
    arm.until_stopped(mara.home)
    arm.resume()
    with pytest.raises(GymMaraError, match="there is no stop to resume from: the arm is waiting"):
        arm.resume()


def test_it_resumes_from_the_measured_pose(mara: RobotModel) -> None:
    arm = in_motion(mara)
    arm.filter.stop("a push")
    arm.until_stopped()
    pushed = arm.q + 0.3
    arm.filter.resume(state_of(pushed, arm.now), arm.now)
    arm.q = pushed
    np.testing.assert_array_equal(arm.tick(None).q, pushed)
    assert np.abs(arm.tick(mara.home).q - pushed).max() < 1e-3


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


@pytest.mark.parametrize("field", ["state_age", "command_age", "tracking_error"])
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
