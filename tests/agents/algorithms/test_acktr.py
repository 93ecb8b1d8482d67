"""ACKTR as an algorithm of Stable-Baselines3: it learns, keeps to its trust region, and is saved and loaded."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import VecNormalize

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.agents.algorithms.acktr import ACKTR, LEAST_STD
from gym_mara.agents.runs.evaluation import make_env
from gym_mara.errors import GymMaraError


class LogCallback(BaseCallback):
    """Keeps the values that each update logs."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[dict[str, float]] = []

    def _on_rollout_start(self) -> None:
        self.rows.append(dict(self.logger.name_to_value))

    def _on_step(self) -> bool:
        return True

    def of(self, name: str) -> list[float]:
        return [values[name] for values in self.rows if name in values]


@pytest.mark.slow
def test_it_learns_a_task_with_discrete_actions() -> None:
    env = make_vec_env("CartPole-v1", n_envs=8, seed=0)
    model = ACKTR("MlpPolicy", env, n_steps=32, seed=0, device="cpu")
    model.learn(40_000)
    rewards, _ = evaluate_policy(model, env, n_eval_episodes=10, return_episode_rewards=True)
    assert np.mean(rewards) > 100.0, "untrained it is about 20"


@pytest.mark.slow
def test_it_learns_to_reach() -> None:
    env = make_env("MARA-v0", "pinocchio", 64, {})
    model = ACKTR(
        "MlpPolicy",
        env,
        n_steps=4,
        gamma=0.0,
        target_kl=1e-2,
        policy_kwargs={"log_std_init": -1.5},
        seed=0,
        device="cpu",
    )
    log = LogCallback()
    model.learn(50_000, callback=log)
    assert np.mean(log.of("train/policy_loss")) < 0.0
    observation: Any = env.reset()
    for _ in range(5):
        action, _ = model.predict(observation, deterministic=True)
        observation, reward, _, _ = env.step(action)
    assert reward.min() > -0.4, "untrained it is -0.99"


@pytest.mark.parametrize("learning_rate", [0.25, 100.0])
def test_an_update_moves_the_policy_no_further_than_the_trust_region(learning_rate: float) -> None:
    env = make_env("MARAOrient-v0", "pinocchio", 16, {})
    model = ACKTR("MlpPolicy", env, learning_rate, n_steps=8, target_kl=2e-3, seed=0, device="cpu")
    log = LogCallback()
    model.learn(16 * 8 * 40, callback=log)
    moved = log.of("train/kl")
    assert len(moved) == 39
    assert max(moved) <= 2e-3
    assert np.median(moved) > 1e-4, "it uses its trust region"
    assert max(log.of("train/critic_kl")) <= model.critic_kl


def test_the_critic_soon_learns_a_constant_offset() -> None:
    """All returns differ from its values by about the same amount."""
    model = ACKTR("MlpPolicy", "Pendulum-v1", n_steps=64, gamma=0.0, seed=0, device="cpu")
    model.set_logger(Logger(None, []))
    observations = torch.randn(64, 3)
    for _ in range(60):
        model._update_critic(observations, 20.0 + 0.01 * torch.randn(64))
    error = model.policy.predict_values(observations).flatten() - 20.0
    assert error.abs().max() < 1.0


def test_one_step_of_one_environment_makes_an_update() -> None:
    model = ACKTR("MlpPolicy", "Pendulum-v1", n_steps=1, seed=0, device="cpu").learn(20)
    assert all(parameter.isfinite().all() for parameter in model.policy.parameters())


def test_observations_may_be_dictionaries() -> None:
    env = DictObservation(gymnasium.make("Pendulum-v1"))
    model = ACKTR("MultiInputPolicy", env, n_steps=32, seed=0, device="cpu")
    log = LogCallback()
    model.learn(32 * 30, callback=log)
    assert 1e-5 < np.median(log.of("train/kl")) <= model.target_kl


class DictObservation(gymnasium.ObservationWrapper):  # type: ignore[type-arg]
    """An environment whose observation is a dictionary."""

    def __init__(self, env: gymnasium.Env) -> None:  # type: ignore[type-arg]
        super().__init__(env)
        self.observation_space = gymnasium.spaces.Dict({"all": env.observation_space})

    def observation(self, observation: Any) -> Any:
        return {"all": observation}


def test_the_first_updates_use_the_plain_gradient() -> None:
    model = ACKTR("MlpPolicy", "Pendulum-v1", n_steps=16, cold_updates=3, seed=0, device="cpu")
    calls = []
    natural = model.actor_optimizer.natural_gradient

    def count(group: dict[str, Any], gradient: torch.Tensor) -> torch.Tensor:
        calls.append(model._n_updates)
        return natural(group, gradient)

    model.actor_optimizer.natural_gradient = count  # type: ignore[method-assign]
    model.learn(16 * 5)
    assert set(calls) == {3, 4}


def test_a_loaded_model_continues_like_the_saved_one(tmp_path: Path) -> None:
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, seed=0))
    model = ACKTR("MlpPolicy", env, n_steps=16, seed=0, device="cpu")
    model.learn(16 * 2 * 15)
    model.save(tmp_path / "model")
    loaded = ACKTR.load(tmp_path / "model", env=env, device="cpu")
    observation = env.observation_space.sample()[None]
    mine, theirs = (m.predict(observation, deterministic=True)[0] for m in (model, loaded))
    np.testing.assert_array_equal(mine, theirs)
    assert loaded.target_kl == model.target_kl
    for before, after in zip(_state(model), _state(loaded), strict=True):
        assert torch.equal(before, after)
    env.training = False  # the two models share its statistics, which must not change
    for learner in (model, loaded):
        env.seed(1)
        env.reset()
        learner._last_obs = None
        set_random_seed(2)
        learner.learn(64, reset_num_timesteps=False)
    for one, other in zip(model.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert torch.equal(one, other)


def test_the_standard_deviation_has_a_lower_bound() -> None:
    model = ACKTR("MlpPolicy", "Pendulum-v1", n_steps=16, seed=0, device="cpu")
    with torch.no_grad():
        model.policy.log_std.fill_(math.log(LEAST_STD) - 1.0)
    model.learn(16)
    assert model.policy.log_std.min().item() == pytest.approx(math.log(LEAST_STD))


def _state(model: ACKTR) -> list[torch.Tensor]:
    optimizers = model.actor_optimizer, model.critic_optimizer
    return [
        value
        for optimizer in optimizers
        for state in optimizer.state_dict()["state"].values()
        for value in state.values()
    ]


def test_it_logs_to_tensorboard(tmp_path: Path) -> None:
    model = ACKTR("MlpPolicy", "CartPole-v1", tensorboard_log=str(tmp_path), device="cpu")
    model.learn(200)
    assert list(tmp_path.glob("ACKTR_1/events*"))


def test_a_policy_with_other_layers_is_refused() -> None:
    class OddPolicy(ActorCriticPolicy):
        def _build_mlp_extractor(self) -> None:
            super()._build_mlp_extractor()
            self.mlp_extractor.policy_net.append(torch.nn.LayerNorm(64))

    with pytest.raises(GymMaraError, match=r"linear layers.*policy_net"):
        ACKTR(OddPolicy, "CartPole-v1", device="cpu")


def test_an_unsupported_action_space_is_refused() -> None:
    class Odd(gymnasium.Env[np.ndarray, np.ndarray]):  # type: ignore[type-arg]
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
        action_space = gymnasium.spaces.MultiBinary(2)  # type: ignore[assignment]

    with pytest.raises(AssertionError, match="only supports"):
        ACKTR("MlpPolicy", Odd(), device="cpu")  # type: ignore[arg-type]
