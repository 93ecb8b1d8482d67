"""The simulated arm: commands in, states out, with a clock of the tests."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_mara.backends import make_backend
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.sim.arm import DONE, REPLACED, RUNNING, Pace, SimulatedArm
from gym_mara.ros2.sim.trajectories import Point
from gym_mara.types import Floats
from tests.helpers import robot_model

SERVO = {"servo_gain": 20.0}


def made(backend: str = "pinocchio", **options: object) -> SimulatedArm:
    return SimulatedArm(make_backend(backend, robot_model("mara"), 1, {**SERVO, **options}))


@pytest.fixture
def arm() -> SimulatedArm:
    return made()


def ticks(arm: SimulatedArm, seconds: float) -> Floats:
    """The joint positions of the ticks (K, J)."""
    return np.stack([arm.tick().q[0] for _ in range(round(seconds / arm.period))])


def near_home(mara: RobotModel, by: float = 0.2) -> Floats:
    return mara.home + by


def test_without_commands_it_rests_at_home(arm: SimulatedArm, mara: RobotModel) -> None:
    assert ticks(arm, 0.2) == pytest.approx(np.tile(mara.home, (10, 1)), abs=1e-9)


@pytest.mark.parametrize("backend", ["pinocchio", "dart", "mujoco"])
def test_it_follows_a_trajectory_in_time_and_holds(backend: str, mara: RobotModel) -> None:
    arm, goal = made(backend), near_home(mara)
    number = arm.follow(mara.joint_names[::-1], [Point(goal[::-1].tolist(), (), 1.0)])
    assert arm.outcome(number) == RUNNING
    way = ticks(arm, 1.0)
    assert np.all(np.diff(way, axis=0) > -1e-3)
    assert way[25] == pytest.approx(mara.home + 0.1, abs=0.02)
    assert arm.outcome(number) == DONE
    assert ticks(arm, 1.0)[-1] == pytest.approx(goal, abs=5e-3)


def test_positions_are_targets_at_once(arm: SimulatedArm, mara: RobotModel) -> None:
    goal = near_home(mara)
    arm.move_to(goal.tolist())
    assert ticks(arm, 0.5)[-1] == pytest.approx(goal, abs=1e-3)


def test_an_empty_trajectory_stops_it(arm: SimulatedArm, mara: RobotModel) -> None:
    first = arm.follow(mara.joint_names, [Point(near_home(mara, 1.0).tolist(), (), 5.0)])
    ticks(arm, 1.0)
    arm.follow((), ())
    assert arm.outcome(first) == REPLACED
    here = arm.state.q[0]
    assert ticks(arm, 0.5)[-1] == pytest.approx(here, abs=1e-3)


def test_the_next_command_begins_where_the_reference_is(
    arm: SimulatedArm, mara: RobotModel
) -> None:
    """A stream of points, each with a time of two periods, as the profile "trajectory" sends them."""
    way = []
    for tick in range(50):
        goal = mara.home + 0.005 * (tick + 1)
        arm.follow(mara.joint_names, [Point(goal.tolist(), [0.25] * 6, 0.04)])
        way.append(arm.tick().q[0])
    assert arm.state.q[0] == pytest.approx(mara.home + 0.25 - 0.25 * (1 / 20 + 0.02), abs=0.01)
    assert np.diff(way, axis=0)[25:] / arm.period == pytest.approx(np.full((24, 6), 0.25), abs=0.01)


def test_the_servos_of_2019_move_at_the_velocity_of_the_point(
    arm: SimulatedArm, mara: RobotModel
) -> None:
    way, speed = np.array([0.5, -0.5, 0.25, 0.0, 0.1, 0.5]), np.array([0.5, -0.5, 0.5, 0.0, 0.2, 1])
    point = Point((mara.home + way)[::-1].tolist(), speed[::-1].tolist(), 0.001)
    number = arm.move_servos(mara.joint_names[::-1], [point, Point([0.0] * 6, (), 1.0)])
    moved = ticks(arm, 1.0) - mara.home
    late = 1.0 / SERVO["servo_gain"]
    assert moved[24] == pytest.approx(np.sign(way) * np.abs(speed) * (0.5 - late), abs=0.01)
    assert arm.outcome(number) == DONE
    assert ticks(arm, 0.5)[-1] == pytest.approx(mara.home + way, abs=1e-3)


def test_a_servo_of_2019_without_speed_stays_and_the_next_command_counts(
    arm: SimulatedArm, mara: RobotModel
) -> None:
    goal = near_home(mara).tolist()
    number = arm.move_servos(mara.joint_names, [Point(goal, [0.5] * 5 + [0.0], 0.001)])
    assert ticks(arm, 1.0)[-1] == pytest.approx([*goal[:5], mara.home[5]], abs=1e-3)
    assert arm.outcome(number) == RUNNING
    moving = arm.move_servos(mara.joint_names, [Point(goal, [0.5] * 6, 0.001)])
    ticks(arm, 0.2)
    arm.move_servos((), ())
    assert arm.outcome(moving) == REPLACED
    assert ticks(arm, 0.5)[-1, 5] == pytest.approx(mara.home[5] + 0.1, abs=0.03)


@pytest.mark.parametrize("bad", [math.nan, math.inf, 1e300])
def test_refused_commands_change_nothing(arm: SimulatedArm, mara: RobotModel, bad: float) -> None:
    goal = near_home(mara)
    number = arm.move_to(goal.tolist())
    values = [*goal[:5].tolist(), bad]
    refused: list[Callable[[], object]] = [
        lambda: arm.move_to(values),
        lambda: arm.move_to(goal[:5].tolist()),
        lambda: arm.move_to([]),
        lambda: arm.move_to([0.0] * 7),
        lambda: arm.follow(mara.joint_names, [Point(values, (), 1.0)]),
        lambda: arm.follow(mara.joint_names, [Point(goal.tolist(), values, 1.0)]),
        lambda: arm.move_servos(mara.joint_names, [Point(goal.tolist(), (), 0.001)]),
        lambda: arm.move_servos(mara.joint_names, [Point(goal.tolist(), values, 0.001)]),
        lambda: arm.move_servos(mara.joint_names, [Point(values, [0.5] * 6, 0.001)]),
        lambda: arm.move_servos(mara.joint_names[:5], [Point(values[:5], [0.5] * 5, 0.001)]),
        lambda: arm.follow(mara.joint_names[:5], [Point(goal[:5].tolist(), (), 1.0)]),
        lambda: arm.follow([*mara.joint_names, "x"], [Point([0.0] * 7, (), 1.0)]),
        lambda: arm.follow(mara.joint_names, [Point(goal.tolist(), (), 1.0)], delay=-2.5),
    ]
    for command in refused:
        with pytest.raises(GymMaraError):
            command()
    assert arm.outcome(number) == RUNNING
    assert ticks(arm, 0.5)[-1] == pytest.approx(goal, abs=1e-3)


@given(st.lists(st.floats(-100.0, 100.0), min_size=6, max_size=6), st.floats(0.0, 0.1))
def test_targets_are_clipped_to_the_limits(goal: list[float], time: float) -> None:
    arm = made()
    mara = arm.robot
    arm.follow(mara.joint_names, [Point(goal, [-v for v in goal], time)])
    for q in ticks(arm, 0.2):
        assert np.all((q >= mara.lower) & (q <= mara.upper))
    arm.move_servos(mara.joint_names, [Point(goal, [-v for v in goal], time)])
    for q in ticks(arm, 0.2):
        assert np.all((q >= mara.lower) & (q <= mara.upper))


def test_a_trajectory_of_a_moment_ago_is_followed(arm: SimulatedArm, mara: RobotModel) -> None:
    goal = near_home(mara)
    arm.follow(mara.joint_names, [Point(goal.tolist(), (), 0.001)], delay=-0.3)
    assert ticks(arm, 0.5)[-1] == pytest.approx(goal, abs=1e-3)


def test_a_reset_puts_it_at_home_and_forgets_commands(arm: SimulatedArm, mara: RobotModel) -> None:
    goal = near_home(mara)
    arm.move_to(goal.tolist())
    ticks(arm, 0.5)
    moving = arm.move_to(goal.tolist())
    done = arm.reset()
    assert not done.is_set()
    time = arm.time
    assert arm.tick().q[0] == pytest.approx(mara.home, abs=1e-6)
    assert done.is_set()
    assert arm.outcome(moving) == REPLACED
    assert ticks(arm, 0.2)[-1] == pytest.approx(mara.home, abs=1e-6)
    assert arm.time > time


def test_each_reset_draws_random_parameters() -> None:
    arm = made("dart", randomisation={"servo_gain": [0.5, 2.0]})
    drawn = []
    for _ in range(3):
        arm.reset()
        parameters = arm.tick().parameters
        assert parameters is not None
        drawn.append(float(parameters["servo_gain"][0, 0]))
    assert len(set(drawn)) == 3


def test_backends_that_jump_and_those_of_many_arms_are_refused(mara: RobotModel) -> None:
    with pytest.raises(GymMaraError, match="servo_gain"):
        SimulatedArm(make_backend("pinocchio", mara, 1, {}))
    with pytest.raises(GymMaraError, match="one arm"):
        SimulatedArm(make_backend("pinocchio", mara, 2, SERVO))


def test_commands_may_come_from_other_threads(arm: SimulatedArm, mara: RobotModel) -> None:
    goal = near_home(mara).tolist()
    ending = threading.Event()

    def command() -> None:
        while not ending.is_set():
            arm.follow(mara.joint_names, [Point(goal, (), 0.04)])
            arm.move_to(goal)

    threads = [threading.Thread(target=command) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        last = ticks(arm, 1.0)[-1]
    finally:
        ending.set()
        for thread in threads:
            thread.join()
    assert last == pytest.approx(goal, abs=1e-3)


class FakeClock:
    """A clock that moves when somebody sleeps."""

    def __init__(self) -> None:
        self.time = 100.0

    def now(self) -> float:
        return self.time

    def sleep_until(self, instant: float) -> None:
        self.time = max(self.time, instant)


def test_ticks_keep_the_pace_and_missed_ones_are_not_made_up_for() -> None:
    clock = FakeClock()
    pace = Pace(0.02, clock)
    times = []
    for tick in range(10):
        pace.wait()
        times.append(round(clock.time - 100.0, 6))
        clock.time += {4: 0.075, 6: 0.019}.get(tick, 0.001)  # work
    assert times == [0.0, 0.02, 0.04, 0.06, 0.08, 0.155, 0.16, 0.18, 0.2, 0.22]
    assert pace.missed == 2
