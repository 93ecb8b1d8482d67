"""Episodes of an evaluation: their seeds, and that batches do not matter."""

from __future__ import annotations

import contextlib
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.evaluation.baselines import StraightMove
from gym_mara.agents.evaluation.episodes import (
    MOST_EPISODES,
    MOST_SEED,
    arms_of_a_batch,
    episode_seeds,
    play_episodes,
)
from gym_mara.agents.runs import evaluation
from gym_mara.agents.runs.evaluation import evaluate_run, make_arms
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.errors import GymMaraError
from gym_mara.types import Floats
from tests.agents.conftest import shorten_episodes

ENV = "MARARandomTarget-v0"
STEPS = 40


def played(arms: int, episodes: int, seed: int = 0) -> dict[str, Floats]:
    """Random episodes in batches of this many arms."""
    options = {"max_joint_velocity": 1.57}
    made = make_arms(ENV, "pinocchio", arms, options, max_episode_steps=None)
    with contextlib.closing(made):
        return play_episodes(made, StraightMove, steps=STEPS, episodes=episodes, seed=seed)


def test_the_size_of_a_batch_changes_nothing() -> None:
    whole = played(7, 7)
    for arms in (1, 3):
        for name, values in played(arms, 7).items():
            np.testing.assert_allclose(values, whole[name], rtol=1e-9, atol=1e-9, err_msg=name)


def test_more_episodes_begin_with_the_same_ones() -> None:
    few, more = played(2, 2), played(5, 5)
    np.testing.assert_allclose(more["return"][:2], few["return"], rtol=1e-9)
    assert len(set(more["return"])) == 5, "all episodes differ"


def test_another_seed_has_other_episodes() -> None:
    assert not set(played(4, 4)["return"]) & set(played(4, 4, seed=1)["return"])


def test_no_two_evaluations_and_no_training_share_an_episode() -> None:
    seeds = [s for seed in (0, 1, 2, MOST_SEED + 1) for s in episode_seeds(seed, 0, 1000)]
    assert len(set(seeds)) == 4000
    assert min(seeds) >= 2**63
    assert episode_seeds(1, 300, 5) == episode_seeds(1, 0, 1000)[300:305]


@pytest.mark.parametrize("steps", [1, 50, 200, 2048, 100_000, 10**6])
@pytest.mark.parametrize("episodes", [1, 5, 1000, 1001, MOST_EPISODES])
def test_a_batch_is_neither_too_large_nor_wasteful(steps: int, episodes: int) -> None:
    arms = arms_of_a_batch(episodes, steps)
    batches = -(-episodes // arms)
    assert (arms - 8) * steps <= 2**17
    assert arms * batches - episodes < 8 * batches
    assert batches == 1 or arms % 8 == 0, "worker processes can share the arms"


@pytest.mark.parametrize("episodes", [0, -1, 1.5, True, MOST_EPISODES + 1, 10**23])
def test_a_wrong_number_of_episodes_is_an_error(episodes: Any) -> None:
    with pytest.raises(GymMaraError, match="episodes must be a"):
        arms_of_a_batch(episodes, 10)


@pytest.mark.parametrize("seed", [-1, 0.5, None])
def test_a_wrong_seed_is_an_error(seed: Any) -> None:
    with pytest.raises(GymMaraError, match="seed must be a whole number of at least 0"):
        episode_seeds(seed, 0, 1)


def test_a_policy_plays_the_same_in_batches(
    finished_run: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_episodes(monkeypatch, STEPS)
    whole = evaluate_run(finished_run, episodes=5)
    monkeypatch.setattr(evaluation, "arms_of_a_batch", lambda episodes, steps: 2)
    for name, values in evaluate_run(finished_run, episodes=5).items():
        np.testing.assert_allclose(values, whole[name], rtol=1e-4, atol=1e-4, err_msg=name)
