"""PPO of skrl on the native vector environment, which resets in the same step, as skrl wants it.

python examples/skrl_ppo.py --steps 50000
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from skrl.agents.torch.ppo import PPO
from skrl.envs.wrappers.torch import wrap_env
from skrl.memories.torch import RandomMemory
from skrl.trainers.torch import SequentialTrainer
from skrl.utils.model_instantiators.torch import deterministic_model, gaussian_model

import gym_mara  # noqa: F401 - registers the environments

ARMS = 64
ROLLOUT = 16


def main() -> None:
    """Train, and say what the mean action earns in a first step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=50_000, help="over all arms")
    steps = parser.parse_args().steps
    torch.manual_seed(0)
    arms = gymnasium.make_vec("gym_mara/MARA-v0", num_envs=ARMS, autoreset_mode="SameStep")
    env = wrap_env(arms, wrapper="gymnasium")
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
    observation = torch.as_tensor(arms.reset(seed=0)[0], dtype=torch.float32)
    with torch.no_grad():
        _, outputs = models["policy"].act({"observations": observation}, role="policy")
    _, reward, _, _, _ = arms.step(outputs["mean_actions"].numpy())
    print(f"reward per step: {reward.mean():.3f}")
    env.close()


if __name__ == "__main__":
    main()
