"""Hindsight experience replay: Stable-Baselines3's SAC on a goal environment with a sparse reward.

python examples/hindsight_replay.py --steps 20000
"""

from __future__ import annotations

import argparse

import gymnasium
import numpy as np
from gymnasium.wrappers import RescaleAction
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy

import gym_mara  # noqa: F401 - registers the environments


def make() -> gymnasium.Env:  # type: ignore[type-arg]
    """Make the environment: a new target in each episode of 50 steps; reward 0 within 5 cm of it, else -1."""
    env = gymnasium.make("gym_mara/MARAGoal-v0", position_tolerance=0.05)
    return RescaleAction(env, np.float32(-1), np.float32(1))


def main() -> None:
    """Train, and print the return of the deterministic policy: -50 for an episode that never reaches its target."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=20_000)
    steps = parser.parse_args().steps
    model = SAC(
        "MultiInputPolicy",
        make(),
        replay_buffer_class=HerReplayBuffer,
        learning_starts=min(1000, steps // 2),
        device="cpu",
        seed=0,
    )
    model.learn(steps)
    reward, spread = evaluate_policy(model, make(), n_eval_episodes=10, warn=False)
    print(f"return of an episode: {reward:.1f} ± {spread:.1f}")


if __name__ == "__main__":
    main()
