"""Statistics of an episode: the class, and the reports of the environments."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import VectorEnv

from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.testing import COPIES
from tests.helpers import Floats

STEPS = 7
NAMES = {
    "ep_steps",
    "num_coll",
    *(f"ep_{what}_{how}" for what in ("dist", "rew") for how in ("max", "mean", "min")),
}


def _expected(distances: Any, rewards: Any, collided: Any) -> dict[str, float]:
    return {
        "ep_steps": len(rewards),
        "num_coll": int(np.sum(collided)),
        "ep_dist_max": np.max(distances),
        "ep_dist_mean": np.mean(distances),
        "ep_dist_min": np.min(distances),
        "ep_rew_max": np.max(rewards),
        "ep_rew_mean": np.mean(rewards),
        "ep_rew_min": np.min(rewards),
    }


def _actions(count: int, seed: int = 0) -> Floats:
    """Random actions (count, 6), rad; about every third leads to a collision."""
    return np.random.default_rng(seed).uniform(-2.3, 2.3, (count, 6))


def test_the_summary_has_the_extremes_the_means_and_the_counts() -> None:
    statistics = EpisodeStatistics(2)
    statistics.add(np.array([0.3, 1.0]), np.array([-1.0, 5.0]), np.array([True, False]))
    statistics.add(np.array([0.1, 2.0]), np.array([3.0, -4.0]), np.array([True, False]))
    summary = statistics.summary()
    assert summary.keys() == NAMES
    assert {name: values.tolist() for name, values in summary.items()} == {
        "ep_steps": [2, 2],
        "num_coll": [2, 0],
        "ep_dist_max": [0.3, 2.0],
        "ep_dist_mean": [0.2, 1.5],
        "ep_dist_min": [0.1, 1.0],
        "ep_rew_max": [3.0, 5.0],
        "ep_rew_mean": [1.0, 0.5],
        "ep_rew_min": [-1.0, -4.0],
    }


def test_clear_resets_the_chosen_episodes() -> None:
    statistics = EpisodeStatistics(2)
    none = np.zeros(2, np.bool_)
    statistics.add(np.array([9.0, 9.0]), np.array([9.0, 9.0]), ~none)
    statistics.clear(np.array([True, False]))
    statistics.add(np.array([1.0, 1.0]), np.array([-2.0, -2.0]), none)
    summary = statistics.summary()
    assert summary["ep_steps"].tolist() == [1, 2]
    assert summary["num_coll"].tolist() == [0, 1]
    assert summary["ep_dist_max"].tolist() == [1.0, 9.0]
    assert summary["ep_rew_max"].tolist() == [-2.0, 9.0]
    assert summary["ep_rew_mean"].tolist() == [-2.0, 3.5]


def test_later_steps_do_not_change_a_summary() -> None:
    statistics = EpisodeStatistics(1)
    one, yes = np.ones(1), np.array([True])
    statistics.add(one, one, yes)
    summary = statistics.summary()
    statistics.add(5 * one, 5 * one, yes)
    statistics.clear(slice(None))
    assert {name: values.item() for name, values in summary.items()} == _expected([1], [1], [1])


def test_the_statistics_of_one_episode_are_plain_numbers_from_the_summary() -> None:
    statistics = EpisodeStatistics(3)
    rng = np.random.default_rng(0)
    for _ in range(4):
        statistics.add(rng.random(3), rng.normal(size=3), rng.random(3) < 0.5)
    for episode in range(3):
        single = statistics.of(episode)
        assert {type(value) for value in single.values()} == {int, float}
        assert single == {n: values[episode] for n, values in statistics.summary().items()}


@pytest.mark.parametrize("duplicate", COPIES)
def test_a_copy_is_independent_of_its_original(
    duplicate: Callable[[EpisodeStatistics], EpisodeStatistics],
) -> None:
    statistics = EpisodeStatistics(1)
    one, yes = np.ones(1), np.array([True])
    statistics.add(one, one, yes)
    other = duplicate(statistics)
    other.add(3 * one, 5 * one, ~yes)
    assert statistics.of(0) == _expected([1], [1], [1])
    assert other.of(0) == _expected([1, 3], [1, 5], [1, 0])


def test_a_single_env_reports_the_statistics_of_the_episode_so_far() -> None:
    env = gymnasium.make("gym_mara/MARACollisionOrient-v0", max_episode_steps=STEPS)
    for episode in range(3):
        env.reset()
        distances, rewards, collisions = [], [], []
        for number, action in enumerate(_actions(STEPS, episode), start=1):
            observation, reward, terminated, truncated, info = env.step(action)
            distances.append(np.sqrt(np.mean(observation[6:9] ** 2)))
            rewards.append(reward)
            collisions.append(info["collided"])
            assert not terminated
            assert truncated == (number == STEPS)
            assert info["statistics"] == pytest.approx(_expected(distances, rewards, collisions))
            assert (
                type(info["statistics"]["num_coll"]) is type(info["statistics"]["ep_steps"]) is int
            )
        assert sum(collisions) > 0


def test_a_terminated_episode_has_statistics(fake_backend: str) -> None:
    env = gymnasium.make(
        "gym_mara/MARA-v0", backend=fake_backend, on_collision="terminate", max_episode_steps=9
    )
    env.reset()
    env.step(np.zeros(6))
    _, _, terminated, truncated, info = env.step(np.full(6, 1.5))
    assert (terminated, truncated) == (True, False)
    assert info["statistics"]["ep_steps"] == 2
    assert info["statistics"]["num_coll"] == 1


def _make_vec(**options: Any) -> VectorEnv[Any, Any, Any]:
    return gymnasium.make_vec("gym_mara/MARACollision-v0", num_envs=3, **options)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_a_vector_env_reports_statistics_at_the_end_of_each_episode(mode: str) -> None:
    env = _make_vec(max_episode_steps=STEPS, autoreset_mode=mode)
    env.reset()
    for episode in range(2):
        distances, rewards, collisions = [], [], []
        for number in range(1, STEPS + 1):
            actions = _actions(3, 100 * episode + number)
            _, reward, terminated, truncated, info = env.step(actions)
            assert truncated.tolist() == [number == STEPS] * 3
            assert not terminated.any()
            final = info.get("final_info", {}) if mode == "SameStep" else info
            assert ("statistics" in final) == (number == STEPS)
            terms = final if number == STEPS else info
            distances.append(terms["distance"])
            rewards.append(reward)
            collisions.append(terms["collided"])
        statistics = final["statistics"]
        assert final["_statistics"].all()
        assert {name for name in statistics if not name.startswith("_")} == NAMES
        for arm in range(3):
            of_arm = {name: statistics[name][arm].item() for name in NAMES}
            expected = _expected(*(np.array(v)[:, arm] for v in (distances, rewards, collisions)))
            assert of_arm == pytest.approx(expected)
        if mode == "NextStep":
            _, reward, _, truncated, info = env.step(_actions(3))
            assert not truncated.any()
            assert not reward.any()
            assert "statistics" not in info
        if mode == "Disabled":
            env.reset(options={"reset_mask": np.ones(3, np.bool_)})


def test_the_statistics_of_a_new_episode_start_from_zero(fake_backend: str) -> None:
    env = _make_vec(
        backend=fake_backend,
        on_collision="terminate",
        autoreset_mode="SameStep",
        max_episode_steps=4,
    )
    env.reset()
    beyond = np.zeros((3, 6))
    beyond[1, 0] = 1.5
    env.step(np.zeros((3, 6)))
    _, _, terminated, _, info = env.step(beyond)
    assert terminated.tolist() == [False, True, False]
    assert info["_final_info"].tolist() == [False, True, False]
    assert info["final_info"]["statistics"]["ep_steps"].tolist() == [0, 2, 0]
    env.step(np.zeros((3, 6)))
    _, _, _, truncated, info = env.step(np.zeros((3, 6)))
    assert truncated.tolist() == [True, False, True]
    assert info["final_info"]["statistics"]["ep_steps"].tolist() == [4, 0, 4]
    assert info["final_info"]["statistics"]["num_coll"].tolist() == [0, 0, 0]
