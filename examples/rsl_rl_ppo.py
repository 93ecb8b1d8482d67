"""PPO of RSL-RL on thousands of arms: simulation, policy and learning on one device, with no copy through the host.

python examples/rsl_rl_ppo.py --arms 8192 --steps 20000000
"""

from __future__ import annotations

import argparse
import copy
import time
from typing import Any

import torch

from gym_mara.envs import MaraVectorEnv
from gym_mara.extras import needs

with needs("this example", "rsl"):
    from rsl_rl.env import VecEnv
    from rsl_rl.runners import OnPolicyRunner
    from tensordict import TensorDict

ROLLOUT, EPISODE, EVALUATION = 24, 256, 100
"""Control steps."""
_NETWORK = {"class_name": "MLPModel", "hidden_dims": [64, 64], "obs_normalization": True}
_NOISE = {"class_name": "GaussianDistribution", "init_std": 0.5, "std_type": "log"}
CONFIG: dict[str, Any] = {
    "num_steps_per_env": ROLLOUT,
    "save_interval": 100,
    "obs_groups": {"actor": ["policy"], "critic": ["policy"]},
    "actor": _NETWORK | {"distribution_cfg": _NOISE},
    "critic": _NETWORK,
    # An action is rewarded a few steps later.
    "algorithm": {"class_name": "PPO", "gamma": 0.9, "entropy_coef": 0.0},
}
"""What differs from RSL-RL's own values, or has none."""


class RslRlEnv(VecEnv):  # type: ignore[misc]
    """A MaraVectorEnv with tensors as RSL-RL's VecEnv. Actions from -1 to 1 are scaled to the action space."""

    def __init__(self, env: MaraVectorEnv) -> None:
        self.env: Any = env
        self.cfg: dict[str, Any] = {}
        self.num_envs = env.num_envs
        self.num_actions = env.simulation.robot.num_joints
        self.max_episode_length = env.max_episode_steps or 0
        self.observation, self.info = env.reset(seed=0)
        self.device = self.observation.device
        self._bound = torch.as_tensor(env.simulation.action_space.high, device=self.device)

    @property
    def episode_length_buf(self) -> torch.Tensor:
        """The number of steps of each episode so far (N,)."""
        return self.env.simulation.statistics.steps

    def get_observations(self) -> Any:
        """The last observation (N, O)."""
        return TensorDict({"policy": self.observation}, batch_size=[self.num_envs])

    def step(self, actions: torch.Tensor) -> tuple[Any, torch.Tensor, torch.Tensor, dict[str, Any]]:
        """Move every arm for one control period; an arm whose episode ends begins the next one."""
        moved = self.env.step(self._bound * actions)
        self.observation, reward, terminated, truncated, self.info = moved
        return self.get_observations(), reward, terminated | truncated, {"time_outs": truncated}


def make(arms: int, device: str, task: str = "MARA-v0") -> RslRlEnv:
    """The arms, with full dynamics and short episodes."""
    options: dict[str, Any] = {"backend": "warp", "arrays": "torch", "device": device}
    options |= {"max_episode_steps": EPISODE, "autoreset_mode": "SameStep"}
    return RslRlEnv(MaraVectorEnv(arms, task, **options))


def train(env: RslRlEnv, steps: int, folder: str | None = None) -> OnPolicyRunner:
    """Train for this many steps over all arms; write policies and a TensorBoard log into the folder."""
    torch.manual_seed(0)
    runner = OnPolicyRunner(env, copy.deepcopy(CONFIG), folder, str(env.device))
    runner.learn(max(1, steps // (ROLLOUT * env.num_envs)))
    return runner


def position_error(env: RslRlEnv, runner: OnPolicyRunner) -> float:
    """The mean position error of the mean action, m, two seconds after the beginning of an episode."""
    policy = runner.get_inference_policy()
    with torch.inference_mode():  # as in the training: what began in this mode must stay in it
        env.observation, _ = env.env.reset()
        for _ in range(EVALUATION):
            env.step(policy(env.get_observations()))
    return float(env.info["position_error"].mean())


def main() -> None:
    """Train, save and evaluate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--task", default="MARA-v0")
    parser.add_argument("--arms", type=int, default=8192)
    parser.add_argument("--steps", type=int, default=20_000_000, help="over all arms")
    parser.add_argument("--device", default="cuda:0", help="or cpu, which is slow")
    parser.add_argument("--out", default="runs/rsl_rl", help="the folder")
    arguments = parser.parse_args()
    env = make(arguments.arms, arguments.device, arguments.task)
    start = time.perf_counter()
    runner = train(env, arguments.steps, arguments.out)
    done = ROLLOUT * env.num_envs * (runner.current_learning_iteration + 1)
    print(f"{done / (time.perf_counter() - start):,.0f} steps per second")
    print(f"position error: {1000 * position_error(env, runner):.1f} mm")
    env.env.close()


if __name__ == "__main__":
    main()
