"""PPO of skrl on the native vector environment, with the autoreset mode that skrl needs.

python examples/skrl_ppo.py --steps 50000
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import torch

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.extras import needs

with needs("this example", "skrl"):
    from skrl.agents.torch.ppo import PPO
    from skrl.envs.wrappers.torch import wrap_env
    from skrl.memories.torch import RandomMemory
    from skrl.trainers.torch import SequentialTrainer
    from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

ARMS = 64
ROLLOUT = 16
SETTLING = 20


def make(env_id: str = "gym_mara/MARA-v0") -> Any:
    """Make the arms, wrapped for skrl."""
    arms = gymnasium.make_vec(env_id, num_envs=ARMS, autoreset_mode="SameStep")
    return wrap_env(arms, wrapper="gymnasium")


def train(env: Any, steps: int) -> PPO:
    """Train for this many steps over all arms."""
    torch.manual_seed(0)
    network = [{"name": "net", "input": "OBSERVATIONS", "layers": [64, 64], "activations": "tanh"}]
    spaces = {
        "observation_space": env.observation_space,
        "action_space": env.action_space,
        "device": env.device,
    }
    models = {
        "policy": gaussian_model(**spaces, network=network, output="ACTIONS", initial_log_std=-0.5),
        "value": deterministic_model(**spaces, network=network, output="ONE"),
    }
    agent = PPO(
        models=models,
        memory=RandomMemory(memory_size=ROLLOUT, num_envs=ARMS, device=env.device),
        **spaces,
        cfg={"rollouts": ROLLOUT, "experiment": {"write_interval": 0, "checkpoint_interval": 0}},
    )
    SequentialTrainer(
        env=env, agents=agent, cfg={"timesteps": max(1, steps // ARMS), "headless": True}
    ).train()
    return agent


def main() -> None:
    """Train, and print the reward per step of the mean action once the arms have settled."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=50_000, help="over all arms")
    env = make()
    agent = train(env, parser.parse_args().steps)
    observation, _ = env.reset()
    # An episode of 2048 steps is at the start pose only once, so the policy has hardly been trained there.
    for _ in range(SETTLING):
        with torch.no_grad():
            seen = {"observations": observation.float()}
            _, outputs = agent.models["policy"].act(seen, role="policy")
        observation, reward, *_ = env.step(outputs["mean_actions"])
    print(f"reward per step: {reward.mean().item():.3f}")
    env.close()


if __name__ == "__main__":
    main()
