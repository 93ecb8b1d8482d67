"""PPO of TorchRL on the native vector environment.

TorchRL's GymWrapper takes vector environments whose autoreset_mode is "SameStep" or "Disabled". Its GymEnv keeps `backend`
for itself and passes keyword arguments of its own on: make the environment with Gymnasium, and wrap it.

    python examples/torchrl_ppo.py --steps 50000
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from gymnasium.spaces import flatdim
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torch import nn
from torchrl.envs import DoubleToFloat, GymWrapper, TransformedEnv
from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import gym_mara  # noqa: F401 - registers the environments

ARMS = 64
ROLLOUT = 16


def main() -> None:
    """Train, and say what a step earns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=50_000, help="over all arms")
    updates = max(1, parser.parse_args().steps // (ARMS * ROLLOUT))
    torch.manual_seed(0)
    arms = gymnasium.make_vec("gym_mara/MARA-v0", num_envs=ARMS, autoreset_mode="SameStep")
    inputs = flatdim(arms.single_observation_space)
    outputs = flatdim(arms.single_action_space)
    env = TransformedEnv(GymWrapper(arms), DoubleToFloat(in_keys=["observation"]))
    network = nn.Sequential(
        nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 2 * outputs), NormalParamExtractor()
    )
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    values = nn.Sequential(nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 1))
    critic = ValueOperator(values, in_keys=["observation"])
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    now = env.reset()
    for _ in range(updates):
        with torch.no_grad():
            rollout = env.rollout(
                ROLLOUT, actor, tensordict=now, auto_reset=False, break_when_any_done=False
            )
            now = env.step_mdp(rollout[:, -1])
            advantage(rollout)
        for _ in range(4):
            terms = loss(rollout.reshape(-1))
            total = sum(terms[name] for name in terms.keys() if name.startswith("loss_"))  # noqa: SIM118
            optimizer.zero_grad()
            total.backward()
            nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
            optimizer.step()
    print(f"reward per step: {rollout['next', 'reward'].mean().item():.3f}")
    env.close()


if __name__ == "__main__":
    main()
