"""Many episodes in batches of arms, each with a seed of its own."""

from __future__ import annotations

import numpy as np

from gym_mara.agents.evaluation.metrics import METRICS, measure
from gym_mara.agents.evaluation.rollout import Begin, roll_out
from gym_mara.envs import MaraVectorEnv
from gym_mara.errors import GymMaraError, short, whole_number
from gym_mara.types import Floats

MOST_EPISODES = 100_000
MOST_SEED = 2**32 - 1
"""The largest seed of an evaluation; beyond it are the seeds of the evaluations that choose the best policy of a training."""
_MOST_STEPS = 2**17
"""Of all arms of a batch together: their trajectories take about 40 MB."""
_SHARED = 8
"""Batches are multiples of this number, so that worker processes can share the arms."""


def arms_of_a_batch(episodes: int, steps: int) -> int:
    """How many arms play this many episodes of this many steps side by side.

    Raises:
        GymMaraError: episodes is out of its range.
    """
    episodes = whole_number(
        "episodes", episodes, at_most=MOST_EPISODES, reason="more would hardly change a figure"
    )
    batches = -(-episodes * steps // _MOST_STEPS)
    arms = -(-episodes // batches)
    return arms if batches == 1 else -(-arms // _SHARED) * _SHARED


def episode_seeds(seed: int, first: int, count: int) -> list[int]:
    """The seeds of an evaluation's episodes from number `first` on.

    Each depends on the evaluation's seed and the episode's number alone. All are at least 2**63, and those of trainings are
    smaller: no evaluation repeats an episode of a training.

    Raises:
        GymMaraError: the seed is no whole number of at least 0.
    """
    if not isinstance(seed, (int, np.integer)) or seed < 0:
        raise GymMaraError(f"seed must be a whole number of at least 0, not {short(seed)}")
    sequences = (np.random.SeedSequence(seed, spawn_key=(first + i,)) for i in range(count))
    return [2**63 | int(sequence.generate_state(1, np.uint64)[0]) for sequence in sequences]


def play_episodes(
    arms: MaraVectorEnv, begin: Begin, *, steps: int, episodes: int, seed: int
) -> dict[str, Floats]:
    """Play episodes, as many at a time as there are arms, and measure each.

    Args:
        arms: with the autoreset mode SAME_STEP and without a time limit.
        begin: what acts.
        steps: the length of an episode.
        episodes: their number.
        seed: of the evaluation.

    Returns:
        Each of METRICS per episode (episodes,).
    """
    batches = []
    for first in range(0, episodes, arms.num_envs):
        seeds = episode_seeds(seed, first, arms.num_envs)
        batches.append(measure(roll_out(arms, begin, seeds, steps)))
    return {name: np.concatenate([batch[name] for batch in batches])[:episodes] for name in METRICS}
