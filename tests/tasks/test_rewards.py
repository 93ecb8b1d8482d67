"""The reward functions: golden values, bounds, monotonicity, batches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gym_mara.tasks import rewards
from gym_mara.types import Floats, Mask
from tests.helpers import golden

ALPHA, BETA, GAMMA, DELTA, ETA, KAPPA = 5.0, 1.5, 1.0, 3.0, 0.03, 0.02

distances = arrays(np.float64, 12, elements=st.floats(0.0, 3.0))
angles = arrays(np.float64, 12, elements=st.floats(0.0, np.pi))
flags = arrays(np.bool_, 12)


def _reward(distance: Floats, angle: Floats, collided: Mask) -> Floats:
    """The total reward of MARACollisionOrient-v0, from the functions under test."""
    return (
        rewards.distance_reward(distance, ALPHA, KAPPA)
        * rewards.orientation_factor(angle, BETA, GAMMA)
        - 1.0
        - rewards.collision_penalty(collided, distance, DELTA, ETA)
    )


def _formula(distance: Floats, angle: Floats, collided: Mask) -> Floats:
    """The same reward, written like the published formula."""
    wide = (np.exp(-ALPHA * distance) - np.exp(-ALPHA)) / (1 - np.exp(-ALPHA))
    peak = (np.exp(-ALPHA * distance / KAPPA) - np.exp(-ALPHA / KAPPA)) / (
        1 - np.exp(-ALPHA / KAPPA)
    )
    aligned = (1 - (angle / np.pi) ** BETA + GAMMA) / (1 + GAMMA)
    penalty = np.where(collided, DELTA * (2 * np.minimum(distance, 0.5)) ** ETA, 0.0)
    return (wide + 10 * peak) * aligned - 1 - penalty


def test_golden_rewards() -> None:
    rows = golden("reward_golden.csv")
    reward = _reward(rows["rmse_m"], rows["angle_rad"], rows["collision"] == 1)
    np.testing.assert_allclose(reward, rows["reward"], rtol=0.0, atol=1e-9)


@given(distances, angles, flags)
def test_the_reward_equals_the_published_formula(
    distance: Floats, angle: Floats, collided: Mask
) -> None:
    np.testing.assert_allclose(
        _reward(distance, angle, collided),
        _formula(distance, angle, collided),
        rtol=0.0,
        atol=1e-12,
    )


@given(distances, angles, flags)
def test_the_best_reward_is_10_and_the_worst_is_bounded(
    distance: Floats, angle: Floats, collided: Mask
) -> None:
    reward = _reward(distance, angle, collided)
    floor = -1.0 - DELTA - np.exp(-ALPHA) / (1.0 - np.exp(-ALPHA))
    assert (reward <= 10.0 + 1e-12).all()
    assert (reward >= floor - 1e-12).all()


def test_the_reward_at_the_target_pose_is_10() -> None:
    at_target = _reward(np.zeros(1), np.zeros(1), np.array([False]))
    assert at_target == pytest.approx(10.0, abs=1e-12)


@given(distances, st.floats(0.5, 20.0), st.floats(0.01, 1.0))
def test_the_distance_reward_never_falls_with_a_smaller_distance(
    distance: Floats, alpha: float, kappa: float
) -> None:
    reward = rewards.distance_reward(np.sort(distance), alpha, kappa)
    assert (np.diff(reward) <= 1e-12).all()
    assert rewards.distance_reward(np.zeros(1), alpha, kappa) == pytest.approx(11.0, abs=1e-12)
    assert rewards.distance_reward(np.ones(1), alpha, kappa) == pytest.approx(0.0, abs=1e-12)


def test_the_distance_reward_rises_with_every_millimetre() -> None:
    distance = np.arange(0.0, 1.0, 1e-3)
    assert (np.diff(rewards.distance_reward(distance, ALPHA, KAPPA)) < 0.0).all()


@given(angles, st.floats(0.1, 5.0), st.floats(0.0, 5.0))
def test_the_orientation_factor_never_falls_with_a_smaller_angle(
    angle: Floats, beta: float, gamma: float
) -> None:
    factor = rewards.orientation_factor(np.sort(angle), beta, gamma)
    assert (np.diff(factor) <= 1e-12).all()
    assert rewards.orientation_factor(np.zeros(1), beta, gamma) == 1.0
    worst = rewards.orientation_factor(np.full(1, np.pi), beta, gamma)
    assert worst == pytest.approx(gamma / (1.0 + gamma), abs=1e-12)


@given(distances, flags)
def test_the_collision_penalty_grows_with_the_distance_up_to_delta(
    distance: Floats, collided: Mask
) -> None:
    penalty = rewards.collision_penalty(collided, np.sort(distance), DELTA, ETA)
    assert (penalty[~collided] == 0.0).all()
    assert (np.diff(penalty[collided]) >= 0.0).all()
    assert (penalty <= DELTA).all()
    assert (penalty[collided & (np.sort(distance) >= 0.5)] == DELTA).all()


@given(distances, angles, flags)
def test_a_batch_gives_the_same_results_as_single_rows(
    distance: Floats, angle: Floats, collided: Mask
) -> None:
    together = _reward(distance, angle, collided)
    for row in range(len(distance)):
        one = slice(row, row + 1)
        alone = _reward(distance[one], angle[one], collided[one])
        np.testing.assert_allclose(together[one], alone, rtol=0.0, atol=1e-12)
