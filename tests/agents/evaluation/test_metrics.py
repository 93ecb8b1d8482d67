"""Each metric has the value that is computed by hand for a small trajectory."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gym_mara.agents.evaluation.metrics import (
    METRICS,
    STATISTICS,
    in_short,
    mean_in_short,
    measure,
    settling_time,
    spread,
    statistics_in_short,
)
from tests.agents.evaluation.conftest import trajectory
from tests.helpers import Floats

NAN = float("nan")


def column(*values: float) -> Floats:
    """The values of one arm, a row for each step."""
    return np.array(values)[:, None]


def check(played: Any, **expected: float | list[float]) -> None:
    """The metrics of a trajectory have these values in its episodes."""
    measured = measure(played)
    for name, values in expected.items():
        np.testing.assert_allclose(measured[name], np.atleast_1d(values), rtol=1e-12, err_msg=name)


def test_every_metric_has_a_value_for_each_episode() -> None:
    measured = measure(trajectory(reward=np.ones((8, 3))))
    assert list(measured) == [*METRICS]
    assert all(values.shape == (3,) for values in measured.values())


def test_errors_are_those_of_the_last_step_and_again_without_collisions() -> None:
    errors = np.array([[0.5, 0.5, 0.5], [0.001, 0.002, 0.004]])
    played = trajectory(
        position_error=errors,
        angle_error=np.radians(10.0 * errors),
        collided=np.array([[False, True, False], [False, False, False]]),
    )
    check(
        played,
        position_error_mm=[1.0, 2.0, 4.0],
        position_error_mm_without_collision=[1.0, NAN, 4.0],
        angle_deg=[0.01, 0.02, 0.04],
        angle_deg_without_collision=[0.01, NAN, 0.04],
        collision_percent=[0.0, 100.0, 0.0],
        collisions=[0.0, 1.0, 0.0],
    )


def test_success_is_at_the_last_step_and_without_any_collision() -> None:
    success = np.array([[0.0, 1.0, 1.0, NAN], [1.0, 0.0, 1.0, NAN]])
    collided = np.array([[False, False, True, False], [False] * 4])
    check(trajectory(success=success, collided=collided), success_percent=[100.0, 0.0, 0.0, NAN])


def test_what_follows_the_end_of_an_episode_does_not_count() -> None:
    belongs = np.array([[True, True], [True, True], [False, True], [False, True]])
    later = np.where(belongs, 0.0, 9.0)
    played = trajectory(
        steps=belongs,
        position_error=later,
        angle_error=later,
        reward=np.where(belongs, -2.0, 9.0),
        collided=~belongs,
        torque=np.dstack([later, later]),
        qd=np.dstack([later, later]),
        action=np.dstack([later, later]),
    )
    check(
        played,
        position_error_mm=[0.0, 0.0],
        angle_deg=[0.0, 0.0],
        reward_per_step=[-2.0, -2.0],
        collisions=[0.0, 0.0],
        highest_torque=[0.0, 0.0],
        highest_velocity=[0.0, 0.0],
        action_rate=[0.0, 0.0],
    )
    np.testing.assert_allclose(measure(played)["return"], [-4.0, -8.0])


@pytest.mark.parametrize(
    ("error", "seconds"),
    [
        ([0.001] * 20, 0.0),
        ([1.0] * 5 + [0.001] * 15, 0.6),
        ([0.001, 1.0] + [0.004] * 18, 0.3),
        ([1.0] * 15 + [0.001] * 5, 1.6),
        ([1.022] * 20, NAN),  # it rests, but far from the target
        ([0.001] * 19 + [1.0], NAN),  # it leaves the target
        ([1.0] * 16 + [0.001] * 4, NAN),  # it only just arrived, and may be passing by
        ([1.0, 0.001] * 10, NAN),
    ],
)
def test_an_arm_has_settled_once_it_stays_within_5_mm(error: list[float], seconds: float) -> None:
    played = trajectory(position_error=np.array([error, [0.001] * 20]).T)
    np.testing.assert_allclose(settling_time(played), [seconds, 0.0])
    check(played, settled_percent=[0.0 if np.isnan(seconds) else 100.0, 100.0])


def test_an_arm_settles_within_the_tolerances_of_its_task() -> None:
    played = trajectory(
        position_error=np.full((20, 1), 1.0), success=column(*[0.0] * 3, *[1.0] * 17)
    )
    check(played, settling_time_s=0.4, settled_percent=100.0)


def test_without_tolerances_and_errors_there_is_no_settling() -> None:
    unknown = np.full((20, 1), NAN)
    check(
        trajectory(position_error=unknown),
        settling_time_s=NAN,
        settled_percent=NAN,
        settling_ratio=NAN,
    )


def test_the_least_time_is_that_of_a_straight_move_to_where_the_arm_settled() -> None:
    q = np.zeros((10, 3, 2))
    q[3:, 0] = [0.2, -0.6]  # which takes 0.2 s and 0.3 s at the limits of 1 and 2 rad/s
    q[4:, 0] = [0.5, -0.6]  # later it drifts within the tolerance
    q[3:, 1] = [0.4, 0.0]  # at full speed
    error = np.zeros((10, 3))
    error[:3, :2] = 1.0  # the third arm is at its target from the start
    check(
        trajectory(position_error=error, q=q),
        settling_time_s=[0.4, 0.4, 0.0],
        settling_ratio=[0.4 / 0.3, 1.0, NAN],
    )


def test_a_joint_that_cannot_move_does_not_count_for_the_least_time() -> None:
    q = np.zeros((10, 1, 2))
    q[1:] = [0.0, 0.4]
    played = trajectory(
        position_error=column(1.0, *[0.0] * 9), q=q, velocity_limit=np.array([0.0, 2.0])
    )
    check(played, settling_time_s=0.2, settling_ratio=1.0)


def test_joints_that_teleport_have_no_least_time_and_no_speed() -> None:
    played = trajectory(
        position_error=column(1.0, *[0.0] * 9),
        q=np.ones((10, 1, 2)),
        qd=np.full((10, 1, 2), NAN),
        velocity_limit=np.full(2, np.inf),
    )
    check(played, settling_ratio=NAN, highest_velocity=NAN, tremble_velocity=NAN)


def test_tremble_is_measured_over_the_last_half_second() -> None:
    tool = np.zeros((12, 2, 3))
    tool[6] = 9.0  # before
    tool[7:, 0] = [[0.0, 0.0, 0.0], [0.003, 0.0, 0.0], [0.0, 0.004, 0.0], [0.0] * 3, [0.0] * 3]
    qd = np.zeros((12, 2, 2))
    qd[6], qd[8, 0], qd[9, 1] = 3.0, [0.1, -0.2], [0.05, 0.0]
    played = trajectory(tool=tool, qd=qd)
    check(played, tremble_mm=[5.0, 0.0], tremble_velocity=[0.2, 0.05], highest_velocity=[3.0, 3.0])


def test_tremble_is_that_before_the_end_of_each_episode() -> None:
    tool = np.zeros((12, 3, 3))
    tool[6:8, 0, 0] = 0.002
    tool[8:, 0] = 9.0  # after its end
    steps = np.arange(12)[:, None] < [8, 12, 4]  # the third episode is shorter than half a second
    check(trajectory(tool=tool, steps=steps), tremble_mm=[2.0, 0.0, NAN])


def test_an_episode_that_ends_with_a_collision_does_not_tremble() -> None:
    tool = np.cumsum(np.full((12, 2, 3), [0.003, 0.0, 0.004]), axis=0)
    collided = np.zeros((12, 2), bool)
    collided[11, 0] = collided[3, 1] = True  # the second arm was put back, and went on
    played = trajectory(tool=tool, collided=collided)
    check(played, tremble_mm=[NAN, 20.0], tremble_velocity=[NAN, 0.0])


def test_a_joint_that_rests_at_every_step_has_moved_between_them() -> None:
    q = np.cumsum(np.full((10, 1, 2), [0.05, 0.02]), axis=0)
    check(trajectory(q=q), highest_velocity=0.5, tremble_velocity=0.5)


def test_an_arm_that_was_put_back_after_a_collision_was_not_fast() -> None:
    q = np.zeros((4, 1, 2))
    q[0] = 0.1
    check(
        trajectory(q=q, collided=np.array([[True], [False], [False], [False]])),
        highest_velocity=1.0,
    )
    check(trajectory(q=10.0 * q), highest_velocity=10.0)


def test_the_action_rate_is_the_root_mean_square_of_the_changes() -> None:
    action = np.zeros((3, 1, 2))
    action[1] = [0.3, 0.0]
    action[2] = [0.3, 0.4]
    check(trajectory(action=action), action_rate=np.sqrt((0.3**2 + 0.4**2) / 4.0))
    check(trajectory(action=action[:1]), action_rate=NAN)


def test_the_highest_torque_is_relative_to_the_limit_of_its_joint() -> None:
    torque = np.zeros((3, 2, 2))
    torque[1, 0], torque[:, 1] = [-5.0, 8.0], NAN
    check(trajectory(torque=torque), highest_torque=[0.5, NAN])


def test_statistics_are_those_of_the_episodes_with_a_value() -> None:
    found = spread({"return": np.array([1.0, NAN, 3.0, 2.0]), "angle_deg": np.array([NAN])})
    assert found["angle_deg"] is None
    expected = (2.0, np.sqrt(2.0 / 3.0), 1.0, 3.0, 2.0, 2.9)
    assert found["return"] == pytest.approx(dict(zip(STATISTICS, expected, strict=True)))


def test_a_share_is_printed_in_percent_and_other_metrics_with_all_statistics() -> None:
    assert statistics_in_short("success_percent", np.array([100.0, 0.0, 100.0])) == ["66.7 %"]
    assert statistics_in_short("tremble_mm", np.array([NAN])) == ["-"]
    values = np.array([1.0, 3.0])
    expected = ["2.000", "1.000", "1.000", "3.000", "2.000", "2.900"]
    assert statistics_in_short("tremble_mm", values) == expected
    assert mean_in_short("tremble_mm", values) == "2.000 ± 1.000"
    assert mean_in_short("tremble_mm", np.array([1.0, NAN])) == "1.000 (1 of 2 episodes)"
    assert mean_in_short("tremble_mm", np.array([NAN, NAN])) == "-"


@pytest.mark.parametrize("value", [-20480.0, -1e5, 999.95, 99.999, 0.1, 0.0999, 5.2e-5, 1e-9, 0.0])
def test_a_number_of_a_table_is_short_and_right(value: float) -> None:
    text = in_short(value)
    assert len(text) <= 7
    assert float(text) == pytest.approx(value, rel=0.05, abs=1e-6)
