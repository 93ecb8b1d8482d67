"""Stable-Baselines3's PPO on gym_mara, with four kinds of environments.

python examples/sb3_ppo.py --way native --steps 100000
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.envs import MaraVectorEnv

ID = "gym_mara:gym_mara/MARA-v0"
"""With the module as prefix, so that worker processes import it too."""


def rescaled(env: gymnasium.Env) -> gymnasium.Env:  # type: ignore[type-arg]
    """Rescale the actions to [-1, 1], as Stable-Baselines3 recommends."""
    return RescaleAction(env, np.float32(-1), np.float32(1))


def single(env_id: str = ID) -> gymnasium.Env:  # type: ignore[type-arg]
    """Make one environment."""
    return rescaled(gymnasium.make(env_id))


def in_turn(env_id: str = ID) -> VecEnv:
    """Make several environments, stepped one after the other."""
    return make_vec_env(env_id, n_envs=4, wrapper_class=rescaled)


def in_processes(env_id: str = ID) -> VecEnv:
    """Make several environments, each in its own process."""
    return make_vec_env(env_id, n_envs=2, wrapper_class=rescaled, vec_env_cls=SubprocVecEnv)


def native() -> VecEnv:
    """Make 256 arms in one batch: by far the fastest."""
    arms = MaraVectorEnv(256, "MARA-v0", autoreset_mode="SameStep")
    return MaraVecEnv(arms, Box(-1, 1, arms.single_action_space.shape))


WAYS: dict[str, Callable[..., Any]] = {
    "single": single,
    "in_turn": in_turn,
    "in_processes": in_processes,
    "native": native,
}


def train(env: Any, steps: int) -> PPO:
    """Train for this many steps over all arms, with the library's defaults, but larger batches for hundreds of arms."""
    arms = getattr(env, "num_envs", 1)
    rollout, batch = 2048 // arms, 256 if arms > 8 else 64
    model = PPO("MlpPolicy", env, n_steps=rollout, batch_size=batch, device="cpu", seed=0)
    return model.learn(steps)


def main() -> None:
    """Train, and print the final position error of the deterministic policy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--way", choices=WAYS, default="native")
    parser.add_argument("--steps", type=int, default=100_000)
    arguments = parser.parse_args()
    env = WAYS[arguments.way]()
    model = train(env, arguments.steps)
    env.close()
    playing = single()
    observation, info = playing.reset(seed=0)
    for _ in range(100):
        action, _ = model.predict(observation, deterministic=True)
        observation, _, _, _, info = playing.step(action)
    print(f"position error: {1000 * info['position_error']:.1f} mm")
    playing.close()


if __name__ == "__main__":
    main()
