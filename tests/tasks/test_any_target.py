"""The tasks for any target: the reward, the success, the drawn episodes and the options."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.tasks import AnyTargetTask, Goal
from gym_mara.tasks.rewards import closeness
from gym_mara.types import Floats

ORIGIN = Goal(np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]]))


def _at(distance: float = 0.0, angle: float = 0.0, **changes: Any) -> SimState:
    """A tool at a distance, m, and an angle, rad, from ORIGIN."""
    half = angle / 2.0
    state = SimState(
        np.zeros((1, 6)),
        np.zeros((1, 6)),
        np.array([[0.0, distance, 0.0]]),
        np.array([[np.cos(half), 0.0, 0.0, np.sin(half)]]),
        np.zeros((1, 3)),
        np.zeros(1, np.bool_),
        np.zeros(1),
    )
    return dataclasses.replace(state, **changes)


def _judged(task: AnyTargetTask, state: SimState) -> tuple[float, dict[str, Floats]]:
    (reward,), terms = task.reward(state, ORIGIN)
    return float(reward), terms


@given(st.floats(-4.0, 1.0), st.floats(0.001, 0.5))
def test_the_reward_falls_at_every_scale_from_a_tenth_of_a_millimetre_to_ten_metres(
    exponent: float, more: float
) -> None:
    near = 10.0**exponent
    one, other = closeness(np.array([near, near * (1.0 + more)]))
    assert one - other > 0.1 * more * near


@pytest.mark.parametrize("orientation", [False, True])
def test_the_reward_is_one_at_the_target_and_less_elsewhere(orientation: bool) -> None:
    task = AnyTargetTask(orientation=orientation)
    assert _judged(task, _at())[0] == 1.0
    assert _judged(task, _at(1e-4))[0] < 1.0
    assert (_judged(task, _at(angle=1e-3))[0] < 1.0) == orientation


def test_an_angle_counts_as_a_distance() -> None:
    task = AnyTargetTask(orientation=True, length_per_angle=0.5)
    turned, _ = _judged(task, _at(0.01, 0.2))
    away, _ = _judged(task, _at(0.11))
    assert turned == pytest.approx(away, abs=1e-9)


def test_the_terms_add_up_with_their_weights() -> None:
    task = AnyTargetTask(rate_weight=0.5, collision_weight=7.0)
    state = _at(0.1, collided=np.ones(1, np.bool_))
    state.fill_actions(np.full((1, 6), 0.5), np.full((1, 6), -0.5))
    reward, terms = _judged(task, state)
    assert terms["reward_rate"] == pytest.approx(-0.5)
    assert terms["reward_collision"] == -7.0
    parts = ("reward_closeness", "reward_rate", "reward_collision")
    assert reward == pytest.approx(sum(float(terms[name][0]) for name in parts))


def test_with_a_guide_the_straight_move_to_the_configuration_is_rewarded_for_its_speed() -> None:
    task = AnyTargetTask(guide=True, progress_weight=2.0)
    ways = np.array([0.1, -0.9, 0.3, 0.0, 0.0, 0.0])
    others = np.full(6, np.inf), np.full(6, 1.5)
    known = np.stack([others[0], ways, others[1]])[None]
    goal = Goal(ORIGIN.position, ORIGIN.quaternion, known)

    def progress(qd: Floats, goal: Goal = goal) -> float:
        return float(task.reward(_at(qd=qd[None]), goal)[1]["reward_progress"][0])

    assert progress(ways) == pytest.approx(2.0 * 0.9)
    assert progress(-0.5 * ways) == pytest.approx(-2.0 * 0.45)
    beside = np.array([0.2, 0.0, 0.0, 0.0, 0.0, -0.3])
    assert progress(ways + beside) == pytest.approx(2.0 * (0.9 - 0.3))
    assert progress(0.0 * ways) == 0.0
    nowhere = Goal(goal.position, goal.quaternion, np.full((1, 2, 6), np.inf))
    assert progress(ways, nowhere) == 0.0


@pytest.mark.parametrize(
    ("distance", "angle", "position", "pose"),
    [
        (0.0, 0.0, True, True),
        (0.0049, 0.0, True, True),
        (0.0051, 0.0, False, False),
        (0.0, 0.099, True, True),
        (0.0, 0.101, True, False),
    ],
)
def test_success_is_within_the_tolerances_and_without_a_collision(
    distance: float, angle: float, position: bool, pose: bool
) -> None:
    tolerances: dict[str, Any] = {"position_tolerance": 0.005, "angle_tolerance": 0.1}
    for orientation, expected in ((False, position), (True, pose)):
        task = AnyTargetTask(orientation=orientation, **tolerances)
        state = _at(distance, angle)
        assert _judged(task, state)[1]["success"].tolist() == [expected]
        state = dataclasses.replace(state, collided=np.ones(1, np.bool_))
        assert _judged(task, state)[1]["success"].tolist() == [False]


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("start", "anywhere", "unknown start 'anywhere'"),
        ("orientation", "yes", "orientation must be"),
        ("position_tolerance", 0.0, "position_tolerance must be"),
        ("position_tolerance", 2.0, "position_tolerance must be"),
        ("angle_tolerance", 4.0, "angle_tolerance must be"),
        ("angle_tolerance", np.nan, "angle_tolerance must be"),
        ("length_per_angle", 0.0, "length_per_angle must be"),
        ("rate_weight", -1.0, "rate_weight must be"),
        ("collision_weight", np.inf, "collision_weight must be"),
        ("slow_within", 0.0, "slow_within must be"),
        ("progress_weight", -0.1, "progress_weight must be"),
        ("guide", 1, "guide must be"),
    ],
)
def test_a_wrong_value_is_an_error(option: str, value: Any, message: str) -> None:
    with pytest.raises(GymMaraError, match=message):
        AnyTargetTask(**{option: value})


def test_a_cost_can_be_zero() -> None:
    task = AnyTargetTask(rate_weight=0.0, collision_weight=0.0)
    state = _at(collided=np.ones(1, np.bool_))
    state.fill_actions(np.ones((1, 6)), -np.ones((1, 6)))
    assert _judged(task, state)[0] == 1.0


def test_episodes_begin_where_the_options_say(mara: RobotModel) -> None:
    workspace, given_q = RobotWorkspace(mara), (0.1, -0.2, 0.3, 0.0, 0.2, 0.1)

    def start(seed: int, **options: Any) -> list[float]:
        drawn = AnyTargetTask(**options).draw(workspace, np.random.default_rng(seed))
        assert drawn.start is not None
        return [*map(float, drawn.start)]

    assert start(0) != start(1)
    assert start(0, start="home") == start(1, start="home") == mara.home.tolist()
    for where in ("random", "home"):
        assert start(0, start=where, start_q=given_q) == list(given_q)
