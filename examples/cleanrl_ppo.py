"""PPO in one file, in the style of CleanRL, on Gymnasium 1.x.

CleanRL's own scripts pass no keyword arguments to the environment. Register an id that contains them, as here.

    python examples/cleanrl_ppo.py --steps 100000
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import torch
from gymnasium.spaces import flatdim
from gymnasium.vector import VectorEnv
from torch import Tensor, nn
from torch.distributions import Normal

import gym_mara  # noqa: F401 - registers the environments

gymnasium.register(
    id="MARA-travelling-v0",
    entry_point="gym_mara.envs:MaraEnv",
    vector_entry_point="gym_mara.envs:MaraVectorEnv",
    kwargs={"task": "MARA-v0", "max_joint_velocity": 1.57},
    max_episode_steps=256,
)
# CleanRL's own values, except gamma, which is 0.99 there; its 2048 steps of one environment are split over many arms.
ARMS, ROLLOUT, EPOCHS, BATCH = 64, 32, 10, 64
GAMMA, LAMBDA, CLIP = 0.95, 0.95, 0.2


class Agent(nn.Module):
    """Actor and critic."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.actor, self.critic = (_network(inputs, size) for size in (outputs, 1))
        self.log_std = nn.Parameter(torch.full((outputs,), -0.5))

    def policy(self, observation: Tensor) -> Normal:
        """The distribution of the joint targets, rad."""
        return Normal(self.actor(observation), self.log_std.exp())


def _network(inputs: int, outputs: int) -> nn.Sequential:
    hidden = nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh()
    return nn.Sequential(*hidden, nn.Linear(64, outputs))


def make(env_id: str = "MARA-travelling-v0") -> VectorEnv[Any, Any, Any]:
    """The arms."""
    return gymnasium.make_vec(env_id, num_envs=ARMS)


def train(envs: VectorEnv[Any, Any, Any], steps: int) -> float:
    """Train for this many steps over all arms; return the mean reward per step of the last rollout."""
    torch.manual_seed(0)
    agent = Agent(flatdim(envs.single_observation_space), flatdim(envs.single_action_space))
    optimizer = torch.optim.Adam(agent.parameters(), lr=3e-4)
    observation = torch.as_tensor(envs.reset(seed=0)[0], dtype=torch.float32)
    began = torch.zeros(ARMS)
    for _ in range(max(1, steps // (ARMS * ROLLOUT))):
        rows = []
        for _ in range(ROLLOUT):
            with torch.no_grad():
                policy = agent.policy(observation)
                action = policy.sample()
                log_prob = policy.log_prob(action).sum(-1)
                value = agent.critic(observation)[:, 0]
            following, reward, terminated, truncated, _ = envs.step(action.numpy())
            rows.append(
                (observation, action, log_prob, value, torch.as_tensor(reward).float(), began)
            )
            observation = torch.as_tensor(following, dtype=torch.float32)
            began = torch.as_tensor(terminated | truncated).float()
        observations, actions, log_probs, values, rewards, begins = map(
            torch.stack, zip(*rows, strict=True)
        )
        advantages = torch.zeros_like(rewards)
        with torch.no_grad():
            after, carried = agent.critic(observation)[:, 0], torch.zeros(ARMS)
            ends = torch.cat([begins[1:], began[None]])
            for t in reversed(range(ROLLOUT)):
                delta = rewards[t] + GAMMA * after * (1.0 - ends[t]) - values[t]
                carried = delta + GAMMA * LAMBDA * (1.0 - ends[t]) * carried
                advantages[t], after = carried, values[t]
        # Gymnasium's vector environments reset in the step after an episode ends: exclude that step from learning.
        real = begins.flatten() == 0.0
        flat = [
            x.flatten(0, 1)[real] for x in (observations, actions, log_probs, advantages, values)
        ]
        for _ in range(EPOCHS):
            for chosen in torch.randperm(len(flat[0])).split(BATCH):
                seen, done, before, gain, old = (x[chosen] for x in flat)
                policy = agent.policy(seen)
                ratio = (policy.log_prob(done).sum(-1) - before).exp()
                scaled = (gain - gain.mean()) / (gain.std() + 1e-8)
                clipped = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
                actor_loss = -torch.min(ratio * scaled, clipped * scaled).mean()
                critic_loss = (agent.critic(seen)[:, 0] - gain - old).square().mean()
                optimizer.zero_grad()
                (actor_loss + 0.5 * critic_loss).backward()
                nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
                optimizer.step()
    return float(rewards.mean())


def main() -> None:
    """Train, and print the reward per step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env-id", default="MARA-travelling-v0")
    parser.add_argument("--steps", type=int, default=100_000, help="over all arms")
    arguments = parser.parse_args()
    envs = make(arguments.env_id)
    print(f"reward per step: {train(envs, arguments.steps):.3f}")
    envs.close()


if __name__ == "__main__":
    main()
