"""Hyperparameters, apart from the code that uses them.

A preset says how many arms an agent trains on, what is normalised, and the arguments of the algorithm. A value that
changes over the run is written as points (progress, value), the progress from 0 to 1, with straight lines between them.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from gym_mara.errors import unknown


@dataclass(frozen=True)
class Preset:
    """How an algorithm trains."""

    num_envs: int
    policy: str = "mlp"
    """The form of the policy, one of `gym_mara.agents.policy.POLICY_CLASSES`."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the algorithm's class; see the module for values that change."""
    normalise_observation: bool = False
    normalise_reward: bool = False


# Where joints are at their targets at once, what comes next hangs on the action alone, hence no discounted future (γ = 0).
# Many arms, short rollouts, a narrow start and a learning rate that falls to zero.
_PPO_TELEPORTING = Preset(
    num_envs=256,
    policy="natural",
    arguments={
        "n_steps": 8,
        "batch_size": 1024,
        "n_epochs": 10,
        "gamma": 0.0,
        "learning_rate": ((0.0, 4e-3), (1.0, 0.0)),
        "clip_range": 0.2,
        "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -1.5},
    },
)
# Where they travel, an action pays off some tenths of a second later.
_PPO_TRAVELLING = Preset(
    num_envs=256,
    policy="natural",
    arguments={
        "n_steps": 32,
        "batch_size": 1024,
        "n_epochs": 10,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 2e-3), (1.0, 0.0)),
        "clip_range": 0.2,
        "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -1.5},
    },
)

# Algorithm → for joints that teleport, and for joints that travel.
PRESETS: dict[str, tuple[Preset, Preset]] = {
    "ppo": (_PPO_TELEPORTING, _PPO_TRAVELLING),
}


def preset(algorithm: str, *, teleports: bool) -> Preset:
    """The preset of an algorithm for arms whose joints are at their targets at once, or travel there.

    Raises:
        GymMaraError: there is no such algorithm.
    """
    if algorithm not in PRESETS:
        raise unknown("algorithm", algorithm, PRESETS)
    teleporting, travelling = PRESETS[algorithm]
    return teleporting if teleports else travelling
