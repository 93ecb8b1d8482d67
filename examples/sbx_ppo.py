"""PPO of sbx (Stable-Baselines3 on JAX) with hundreds of arms in one batch.

python examples/sbx_ppo.py --steps 100000
"""

from __future__ import annotations

import argparse
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from stable_baselines3.common.vec_env import VecEnv

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.envs import MaraVectorEnv
from gym_mara.extras import needs

with needs("this example", "sbx"):
    from sbx import PPO

ARMS = 256
ROLLOUT = 2


def make(env_id: str = "gym_mara/MARA-v0") -> VecEnv:
    """Make the arms. Their actions are rescaled to [-1, 1]; JAX converts float64 observations to float32."""
    arms = gymnasium.make_vec(env_id, num_envs=ARMS, autoreset_mode="SameStep")
    return MaraVecEnv(cast(MaraVectorEnv, arms), Box(-1, 1, arms.single_action_space.shape))


def train(env: VecEnv, steps: int) -> Any:
    """Train for this many steps over all arms, and return the model."""
    model = PPO(
        "MlpPolicy",
        env,
        n_steps=ROLLOUT,
        batch_size=128,
        n_epochs=5,
        gamma=0.9,
        learning_rate=lambda remaining: 3e-3 * remaining,
        policy_kwargs={"log_std_init": -2.0, "ortho_init": True},  # off by default in sbx
        seed=0,
    )
    return model.learn(steps)


def main() -> None:
    """Train, and print the final position error of the deterministic policy."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100_000, help="over all arms")
    steps = parser.parse_args().steps
    env = make()
    model = train(env, steps)
    observation = env.reset()
    for _ in range(100):
        action, _ = model.predict(observation, deterministic=True)
        observation, _, _, _ = env.step(action)
    error = (np.asarray(observation)[0, 6:9] ** 2).sum() ** 0.5
    print(f"position error: {1000 * error:.1f} mm")
    env.close()


if __name__ == "__main__":
    main()
