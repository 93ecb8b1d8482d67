"""PPO of RLlib (new API stack) with the native vector environment in remote env runners.

python examples/rllib_ppo.py --steps 200000
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import numpy as np
import torch

from gym_mara.extras import needs

with needs("this example", "rllib"):
    import ray
    from ray.rllib.algorithms.ppo import PPOConfig
    from ray.rllib.core.rl_module.default_model_config import DefaultModelConfig

ID = "gym_mara:gym_mara/MARA-v0"
"""With the module as prefix, so that the processes of the env runners import it too."""
ARMS = 32
BATCH = 2048
PATIENCE = 60
"""Number of iterations without a step before the training stops; each lasts some seconds if every env runner has died."""


def config(env_id: str = ID, env_runners: int = 2) -> PPOConfig:
    """Configure PPO on `env_id` with ARMS arms in each env runner; env_config takes keyword arguments of the environment."""

    # A nested function, so that Ray sends its code: the env runners do not need to import this file.
    def log_reward(*, samples: list[Any], metrics_logger: Any, **_: Any) -> None:
        rewards = np.concatenate([episode.get_rewards() for episode in samples])
        metrics_logger.log_value("reward_per_step", rewards.mean(), window=1)

    return (
        PPOConfig()
        # Actions in rad: normalised to the action space of ±π, RLlib's first policy would be π times as noisy.
        .environment(env_id, env_config={}, normalize_actions=False, clip_actions=True)
        .env_runners(
            num_env_runners=env_runners,
            num_envs_per_env_runner=ARMS,
            gym_env_vectorize_mode=gymnasium.VectorizeMode.VECTOR_ENTRY_POINT,
        )
        .callbacks(on_sample_end=log_reward)
        .fault_tolerance(restart_failed_env_runners=True)
        .training(
            train_batch_size_per_learner=BATCH,
            minibatch_size=256,
            num_epochs=8,
            lr=5e-4,
            gamma=0.9,
            lambda_=0.95,
            use_kl_loss=False,
            grad_clip=0.5,
        )
        .rl_module(model_config=DefaultModelConfig(fcnet_hiddens=[64, 64], vf_share_layers=False))
        .debugging(seed=0)
    )


def train(config: PPOConfig, steps: int) -> float:
    """Train for at least `steps` steps over all arms; return the mean reward per step of the last batch."""
    # RLlib hides an error of the environment behind its own IndexError: make the environment here first.
    gymnasium.make_vec(
        config.env, vectorization_mode=config.gym_env_vectorize_mode, **config.env_config
    ).close()
    algorithm = config.build_algo()
    try:
        sampled, reward, without = 0, float("nan"), 0
        while sampled < steps:
            result = algorithm.train()["env_runners"]
            before, sampled = sampled, result["num_env_steps_sampled_lifetime"]
            reward = result["reward_per_step"]
            # RLlib restarts env runners that died, and waits forever if they cannot start.
            without = without + 1 if sampled == before else 0
            if without == PATIENCE:
                raise RuntimeError(
                    f"the env runners took no step in {PATIENCE} iterations: see Ray's log"
                )
        return float(reward)
    finally:
        algorithm.stop()


def main() -> None:
    """Train, and print the reward per step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env-id", default=ID)
    parser.add_argument("--env-runners", type=int, default=2)
    parser.add_argument("--steps", type=int, default=200_000, help="over all arms")
    arguments = parser.parse_args()
    torch.set_num_threads(1)  # for the learner; the env runners use the other cores
    # A new Ray instance on this machine, with enough CPUs: an env runner without a free CPU would wait forever.
    with ray.init("local", num_cpus=max(2, arguments.env_runners), include_dashboard=False):
        reward = train(config(arguments.env_id, arguments.env_runners), arguments.steps)
    print(f"reward per step: {reward:.3f}")


if __name__ == "__main__":
    main()
