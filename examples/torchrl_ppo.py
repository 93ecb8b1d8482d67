"""PPO of TorchRL on the native vector environment.

TorchRL's GymWrapper accepts vector environments with the autoreset_mode "SameStep" or "Disabled". Its GymEnv does not work here:
it uses the argument `backend` itself, and passes additional arguments to the environment.

    python examples/torchrl_ppo.py --steps 50000
"""

from __future__ import annotations

import argparse

import gymnasium
import torch
from torch import nn

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.extras import needs

with needs("this example", "torchrl"):
    from tensordict.nn import NormalParamExtractor, TensorDictModule
    from torchrl.envs import DoubleToFloat, EnvBase, GymWrapper, TransformedEnv
    from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
    from torchrl.objectives import ClipPPOLoss
    from torchrl.objectives.value import GAE

# 2048 frames and ten epochs, as in TorchRL's own PPO for MuJoCo, but split over many arms and in larger batches.
ARMS, ROLLOUT, EPOCHS, BATCH = 64, 32, 10, 256


def make(env_id: str = "gym_mara/MARA-v0") -> EnvBase:
    """Make the arms, wrapped for TorchRL."""
    arms = gymnasium.make_vec(env_id, num_envs=ARMS, autoreset_mode="SameStep")
    return TransformedEnv(GymWrapper(arms), DoubleToFloat(in_keys=["observation"]))


def _network(inputs: int, outputs: int) -> nn.Sequential:
    hidden = nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()
    return nn.Sequential(*hidden, nn.Linear(64, outputs))


def train(env: EnvBase, steps: int) -> float:
    """Train for this many steps over all arms; return the mean reward per step of the last rollout."""
    torch.manual_seed(0)
    inputs = env.observation_spec["observation"].shape[-1]
    outputs = env.action_spec.shape[-1]
    network = nn.Sequential(_network(inputs, 2 * outputs), NormalParamExtractor())
    actor = ProbabilisticActor(
        TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(_network(inputs, 1), in_keys=["observation"])
    advantage = GAE(gamma=0.9, lmbda=0.95, value_network=critic)
    loss = ClipPPOLoss(actor, critic)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
    now = env.reset()
    for _ in range(max(1, steps // (ARMS * ROLLOUT))):
        with torch.no_grad():
            rollout = env.rollout(
                ROLLOUT, actor, tensordict=now, auto_reset=False, break_when_any_done=False
            )
            now = env.step_mdp(rollout[:, -1])
            advantage(rollout)
        samples = rollout.reshape(-1)
        for _ in range(EPOCHS):
            for chosen in torch.randperm(len(samples)).reshape(-1, BATCH):
                terms = loss(samples[chosen])
                total = sum(terms[name] for name in terms.keys() if name.startswith("loss_"))  # noqa: SIM118
                optimizer.zero_grad()
                total.backward()
                nn.utils.clip_grad_norm_(loss.parameters(), 0.5)
                optimizer.step()
    return float(rollout["next", "reward"].mean())


def main() -> None:
    """Train, and print the reward per step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=50_000, help="over all arms")
    env = make()
    print(f"reward per step: {train(env, parser.parse_args().steps):.3f}")
    env.close()


if __name__ == "__main__":
    main()
