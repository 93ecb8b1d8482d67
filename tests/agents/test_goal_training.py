"""A goal environment is trained, resumed and played like any other; its observations are dictionaries."""

from __future__ import annotations

from pathlib import Path

import gymnasium
import numpy as np
import pytest
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import PPO

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.evaluation import evaluate_run
from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.training.train import resume, train
from gym_mara.errors import GymMaraError
from tests.agents.conftest import silent

ID = "gym_mara/MARAGoal-v0"


@pytest.fixture(scope="module")
def goal_run(tmp_path_factory: pytest.TempPathFactory) -> RunFolder:
    asked = RunConfig(
        "MARAGoal-v0",
        "ppo",
        "pinocchio",
        1536,
        0,
        checkpoint_every=512,
        env_options={"reward_type": "dense"},
    )
    return train(asked, tmp_path_factory.mktemp("goal") / "run", silent)


def test_the_policy_plays_on_its_environment_alike_in_every_way(goal_run: RunFolder) -> None:
    env = gymnasium.make(ID)
    observation, _ = env.reset(seed=1)
    targets, _ = load_policy(goal_run).predict(observation)
    assert targets.shape == (6,)
    env.step(targets)
    rescaled = RescaleAction(env, np.float32(-1), np.float32(1))
    model = PPO.load(goal_run.path / "last/model.zip", env=rescaled, device="cpu")
    action, _ = model.predict(observation, deterministic=True)
    np.testing.assert_allclose(rescaled.action(action), targets, atol=1e-6)  # type: ignore[attr-defined]
    with pytest.raises(GymMaraError, match=r"actions are in \[-1, 1\]"):
        env.step(action)


def test_a_batch_of_dictionaries_has_a_batch_of_targets(goal_run: RunFolder) -> None:
    envs = gymnasium.make_vec(ID, num_envs=3)
    observations, _ = envs.reset(seed=1)
    targets, _ = load_policy(goal_run).predict(observations)
    assert targets.shape == (3, 6)


def test_its_episodes_have_the_length_of_the_environment(goal_run: RunFolder) -> None:
    metrics = evaluate_run(goal_run, episodes=2)
    np.testing.assert_allclose(metrics["return"], 50 * metrics["reward_per_step"])


def test_a_resumed_run_is_the_same(goal_run: RunFolder, tmp_path: Path) -> None:
    class Stop(Exception):  # noqa: N818
        pass

    def stop(steps: int, shown: dict[str, float]) -> None:
        if steps > 600:
            raise Stop

    with pytest.raises(Stop):
        train(goal_run.config, tmp_path / "run", stop)
    again = resume(tmp_path / "run", silent)
    observation = gymnasium.make(ID).reset(seed=2)[0]
    expected, _ = load_policy(goal_run).predict(observation)
    np.testing.assert_array_equal(load_policy(again).predict(observation)[0], expected)


def test_another_observation_is_refused(goal_run: RunFolder) -> None:
    policy = load_policy(goal_run)
    with pytest.raises(
        GymMaraError, match="dictionary of achieved_goal, desired_goal, observation"
    ):
        policy.predict(np.zeros(15))
    observation = gymnasium.make(ID).reset(seed=0)[0]
    with pytest.raises(GymMaraError, match="NaN or infinity"):
        policy.predict({**observation, "desired_goal": np.full(3, np.nan)})
