"""PPO of Tianshou 2 on the native vector environment, through a small adapter.

Tianshou has its own class of vector environments, and resets ended episodes itself. It therefore needs
autoreset_mode="Disabled".

    python examples/tianshou_ppo.py --steps 100000
"""

from __future__ import annotations

import argparse
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import flatdim
from numpy.typing import NDArray
from torch import nn
from torch.distributions import Distribution, Independent, Normal

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.extras import needs

with needs("this example", "tianshou"):
    from tianshou.algorithm import PPO
    from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
    from tianshou.algorithm.optim import AdamOptimizerFactory, LRSchedulerFactoryLinear
    from tianshou.data import Batch, Collector, VectorReplayBuffer
    from tianshou.env import BaseVectorEnv
    from tianshou.trainer import OnPolicyTrainerParams
    from tianshou.utils.net.common import Net
    from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic

ARMS = 64
ROLLOUT = 8
SETTLING = 20


class NativeVectorEnv(BaseVectorEnv):  # type: ignore[misc]
    """Adapts a Gymnasium vector environment without autoreset to Tianshou's collector.

    A step always moves all arms: collect steps (`n_step`), not episodes. The `info` of the environment is dropped.
    """

    def __init__(self, env: gymnasium.vector.VectorEnv[Any, Any, Any]) -> None:
        # Do not call the base class: it would make one Python worker per arm.
        self.env, self.env_num, self.is_async, self.is_closed = env, env.num_envs, False, False

    def get_env_attr(self, key: str, id: Any = None) -> list[Any]:  # noqa: A002 - Tianshou's name
        """Return an attribute of one arm for every arm: single_action_space for action_space, and so on."""
        return [getattr(self.env, f"single_{key}")] * self.env_num

    def reset(self, env_id: Any = None, **kwargs: Any) -> tuple[Any, NDArray[Any]]:
        """Reset all arms or some of them."""
        arms = np.arange(self.env_num)[slice(None) if env_id is None else env_id]
        mask = np.isin(np.arange(self.env_num), arms)
        observation, _ = self.env.reset(options={"reset_mask": mask}, **kwargs)
        return observation[arms], np.array([{} for _ in arms])

    def step(self, action: Any, id: Any = None) -> Any:  # noqa: A002
        """Move every arm."""
        observation, reward, terminated, truncated, _ = self.env.step(action)
        return observation, reward, terminated, truncated, np.array([{}] * self.env_num)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()
        self.is_closed = True


def make(env_id: str = "gym_mara/MARA-v0") -> NativeVectorEnv:
    """Make the arms in one batch."""
    return NativeVectorEnv(gymnasium.make_vec(env_id, num_envs=ARMS, autoreset_mode="Disabled"))


def gaussian(loc_scale: tuple[torch.Tensor, torch.Tensor]) -> Distribution:
    """Make the distribution of the actions, where [-1, 1] is the range of each joint."""
    return Independent(Normal(*loc_scale), 1)


def train(env: NativeVectorEnv, steps: int) -> ProbabilisticActorPolicy:
    """Train for this many steps over all arms, and return the policy."""
    torch.manual_seed(0)
    observations, actions = (
        env.get_env_attr("observation_space")[0],
        env.get_env_attr("action_space")[0],
    )
    network = {
        "state_shape": flatdim(observations),
        "hidden_sizes": [64, 64],
        "activation": nn.Tanh,
    }
    actor = ContinuousActorProbabilistic(
        preprocess_net=Net(**network), action_shape=actions.shape, unbounded=True
    )
    nn.init.constant_(actor.sigma_param, -2.0)
    policy = ProbabilisticActorPolicy(
        actor=actor, dist_fn=gaussian, action_space=actions, deterministic_eval=True
    )
    rollout = ARMS * ROLLOUT
    adam = AdamOptimizerFactory(lr=3e-3).with_lr_scheduler_factory(
        LRSchedulerFactoryLinear(1, steps, rollout)
    )
    algorithm = PPO(
        policy=policy,
        critic=ContinuousCritic(preprocess_net=Net(**network)),
        optim=adam,
        gamma=0.0,  # the next state depends only on the action
        ent_coef=0.0,
        max_grad_norm=0.5,
    )
    algorithm.run_training(
        OnPolicyTrainerParams(
            training_collector=Collector(policy, env, VectorReplayBuffer(rollout, ARMS)),
            max_epochs=1,
            epoch_num_steps=steps,
            collection_step_num_env_steps=rollout,
            batch_size=128,
            update_step_num_repetitions=5,
            verbose=False,
            show_progress=False,
        )
    )
    return policy


def main() -> None:
    """Train, and print the reward per step of the mean action once the arms have settled."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=100_000, help="over all arms")
    steps = parser.parse_args().steps
    env = make()
    policy = train(env, steps)
    observation, _ = env.reset()
    # An episode of 2048 steps is at the start pose only once, so the policy has hardly been trained there.
    for _ in range(SETTLING):
        with torch.no_grad():
            action = policy.map_action(policy(Batch(obs=observation, info=Batch())).act)
        observation, reward, *_ = env.step(action)
    print(f"reward per step: {reward.mean():.3f}")
    env.close()


if __name__ == "__main__":
    main()
