"""Joint states by name: what is accepted, in which order, and every refusal."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_mara.robot import RobotModel
from gym_mara.ros2 import joints
from gym_mara.ros2.joints import JointMap
from tests.helpers import robot_model

NAMES = [f"motor{number}" for number in range(1, 7)]
Q = [0.1, -0.2, 0.3, -0.4, 0.5, -0.6]


@pytest.fixture
def joint_map(mara: RobotModel) -> JointMap:
    return JointMap(mara)


def refusal(joint_map: JointMap, names: list[str], *values: Any, **more: Any) -> str:
    """The reason for which a state is refused, and that it is counted once."""
    before = joint_map.refused.total()
    assert joint_map.read(names, *values, **{"received": 1.0, **more}) is None
    assert joint_map.refused.total() == before + 1
    assert joint_map.last_refusal is not None
    return joint_map.last_refusal


@given(st.permutations(range(9)), st.booleans())
def test_any_order_with_any_other_joints(order: list[int], all_given: bool) -> None:
    names = [*NAMES, "gripper_left", "gripper_right", "ur_motor1"]
    values = [*Q, math.nan, 1e30, 0.0]  # what others report does not matter
    shuffled = [names[index] for index in order]
    own = [values[index] for index in order]
    more = [[-value for value in own], [2.0 * value for value in own]] if all_given else []
    state = JointMap(robot_model("mara")).read(shuffled, own, *more, received=5.0, stamp=7.0)
    assert state is not None
    assert state.q.tolist() == Q
    assert state.qd.tolist() == ([-value for value in Q] if all_given else [0.0] * 6)
    assert (state.received, state.stamp) == (5.0, 7.0)
    if all_given:
        assert state.effort is not None
        assert state.effort.tolist() == [2.0 * value for value in Q]
    else:
        assert state.effort is None


@given(st.lists(st.floats(), max_size=8), st.lists(st.floats(), max_size=8))
def test_no_state_is_ever_incomplete_or_not_finite(
    position: list[float], velocity: list[float]
) -> None:
    state = JointMap(robot_model("mara")).read(NAMES, position, velocity, received=1.0)
    if state is not None:
        assert state.q.shape == state.qd.shape == (6,)
        assert np.isfinite([state.q, state.qd]).all()


def test_the_order_may_change_from_state_to_state(joint_map: JointMap) -> None:
    for names, values in ((NAMES, Q), (NAMES[::-1], Q[::-1]), (NAMES, Q)):
        state = joint_map.read(names, values, received=1.0)
        assert state is not None
        assert state.q.tolist() == Q


def test_partial_states_name_what_is_missing(joint_map: JointMap) -> None:
    assert (
        refusal(joint_map, NAMES[:4], Q[:4])
        == "missing joints: motor5, motor6 of the robot's joints"
    )


def test_states_of_other_joints_are_refused(joint_map: JointMap) -> None:
    assert refusal(joint_map, ["a", "b"], [0.0, 0.0]).startswith("unknown joints: none of a, b")
    assert refusal(joint_map, [], []).startswith("unknown joints")


def test_a_prefix_is_explained(joint_map: JointMap) -> None:
    reason = refusal(joint_map, [f"left_{name}" for name in NAMES], Q)
    assert "the prefix 'left_'" in reason


def test_duplicate_joints_are_refused_and_of_others_not(joint_map: JointMap) -> None:
    assert refusal(joint_map, [*NAMES, "motor2"], [*Q, 0.0]).startswith("duplicate joints: motor2")
    assert joint_map.read([*NAMES, "x", "x"], [*Q, 0.0, 0.0], received=1.0) is not None


@pytest.mark.parametrize("values", [(Q[:5],), ([],), (Q, Q[:5]), (Q, [], [1.0]), ([*Q, 0.0],)])
def test_lengths_must_fit(joint_map: JointMap, values: tuple[list[float], ...]) -> None:
    assert refusal(joint_map, NAMES, *values).startswith("lengths that do not fit")


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e300])
@pytest.mark.parametrize("what", [0, 1, 2])
def test_what_is_not_finite_is_refused(joint_map: JointMap, bad: float, what: int) -> None:
    values = [list(Q) for _ in range(3)]
    values[what][3] = bad
    reason = refusal(joint_map, NAMES, *values)
    assert reason.startswith("not finite")
    assert "motor4" in reason


def test_velocities_and_efforts_that_are_all_nan_are_none(joint_map: JointMap) -> None:
    state = joint_map.read(NAMES, Q, [math.nan] * 6, [math.nan] * 6, received=1.0)
    assert state is not None
    assert state.effort is None
    assert not state.qd.any()


def test_positions_may_be_a_little_beyond_the_limits(joint_map: JointMap, mara: RobotModel) -> None:
    beyond = mara.upper.copy()
    beyond[1] += 0.09
    assert joint_map.read(NAMES, beyond.tolist(), received=1.0) is not None
    beyond[1] += 0.02
    reason = refusal(joint_map, NAMES, beyond.tolist())
    assert reason.startswith("beyond the limits: motor2")
    assert refusal(joint_map, NAMES, [90.0] * 6).startswith("beyond the limits")  # degrees


def test_stamps_must_advance(joint_map: JointMap) -> None:
    def read(stamp: float) -> Any:
        return joint_map.read(NAMES, Q, received=1.0, stamp=stamp)

    assert read(100.0) is not None
    assert read(100.0) is None
    assert read(99.9) is None
    assert read(100.1) is not None
    assert joint_map.refused == {joints.REPEATED: 1, joints.OUT_OF_ORDER: 1}
    for stamp in (math.nan, math.inf, -1.0):
        assert read(stamp) is None
    assert read(100.2) is not None


def test_after_a_clock_was_set_back_its_states_count_again(joint_map: JointMap) -> None:
    for stamp, accepted in ((100.0, True), (1.0, False), (1.1, True), (1.2, True)):
        state = joint_map.read(NAMES, Q, received=1.0, stamp=stamp)
        assert (state is not None) == accepted


def test_of_two_senders_with_two_clocks_one_counts(joint_map: JointMap) -> None:
    accepted = []
    for tick in range(20):
        for start in (1000.0, 10.0):
            stamp = start + 0.02 * tick
            if joint_map.read(NAMES, Q, received=1.0, stamp=stamp) is not None:
                accepted.append(stamp >= 1000.0)
    assert all(accepted) or not any(accepted[1:])


@pytest.mark.parametrize("offset", [0.0, 1.7e9])
def test_a_state_that_is_long_on_its_way_is_refused(joint_map: JointMap, offset: float) -> None:
    """The offset of the clocks does not matter."""

    def read(tick: int, delay: float) -> bool:
        time = 10.0 + 0.02 * tick
        state = joint_map.read(NAMES, Q, received=time + delay, stamp=time + offset)
        return state is not None

    assert all(read(tick, 0.001 + 0.1 * (tick % 3 == 0)) for tick in range(400))
    assert not any(read(tick, 0.5) for tick in range(400, 500))
    assert joint_map.refused == {joints.TOO_LATE: 100}
    assert read(500, 0.001)


@pytest.mark.parametrize("speed", [0.97, 1.03])
def test_a_clock_that_is_a_little_slow_or_fast_is_not_late(
    joint_map: JointMap, speed: float
) -> None:
    for tick in range(5000):
        time = 10.0 + 0.02 * tick
        assert joint_map.read(NAMES, Q, received=time, stamp=5.0 + speed * time) is not None


def test_states_without_stamps_are_accepted(joint_map: JointMap) -> None:
    for received in (1.0, 1.0, 2.0):
        assert joint_map.read(NAMES, Q, received=received) is not None


@pytest.mark.parametrize("stamped", [True, False])
def test_missing_velocities_are_differences(joint_map: JointMap, stamped: bool) -> None:
    for tick in range(5):
        time = 50.0 + 0.02 * tick
        late = 0.2 * (tick % 2) if stamped else 0.0  # the times of arrival do not count
        stamp = time if stamped else 0.0
        values = [q + 0.5 * 0.02 * tick for q in Q]
        state = joint_map.read(NAMES, values, received=time + late, stamp=stamp)
        assert state is not None
        assert state.qd == pytest.approx([0.5 if tick else 0.0] * 6)


def test_states_in_a_burst_make_no_high_velocities(joint_map: JointMap) -> None:
    for tick in range(100):
        received = 1.0 + 0.02 * (tick // 10) + 1e-6 * (tick % 10)  # ten at once
        state = joint_map.read(NAMES, [q + 0.001 * tick for q in Q], received=received)
        assert state is not None
        assert np.abs(state.qd).max() < 0.6  # they move by 0.5 rad/s
