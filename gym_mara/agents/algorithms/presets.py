"""Hyperparameters, apart from the code that uses them.

A preset says how many arms an agent trains on, what is normalised, and the arguments of the algorithm. A value that
changes over the run is written as points (progress, value), the progress from 0 to 1, with straight lines between them;
an optimiser by its name in torch.optim.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from gym_mara.errors import unknown

POLICY_FORMS = ("mlp", "natural")
"""Stable-Baselines3's own, and `gym_mara.agents.algorithms.natural_gaussian`'s."""


@dataclass(frozen=True)
class Preset:
    """How an algorithm trains.

    Raises:
        GymMaraError: the form of the policy is unknown.
    """

    num_envs: int
    policy: str = "mlp"
    """The form of the policy, one of POLICY_FORMS."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the algorithm's class; see the module for values that change."""
    normalise_observation: bool = False
    normalise_reward: bool = False

    def __post_init__(self) -> None:
        if self.policy not in POLICY_FORMS:
            raise unknown("policy", self.policy, POLICY_FORMS)


# Where joints are at their targets at once, what comes next hangs on the action alone, hence no discounted future (γ = 0).
# Many arms and short rollouts: once the tool is in place, the angle is found by walking along a narrow curved valley, a
# part of the policy's standard deviation at each update, so that many updates matter more than good ones.
_PPO_TELEPORTING = Preset(
    num_envs=256,
    policy="natural",
    arguments={
        "n_steps": 2,
        "batch_size": 256,
        "n_epochs": 2,
        "gamma": 0.0,
        "learning_rate": ((0.0, 0.06), (0.7, 0.06), (1.0, 0.0)),
        "clip_range": 0.2,
        "vf_coef": 0.1,
        "max_grad_norm": 10.0,
        "policy_kwargs": {
            "net_arch": [64, 64],
            "log_std_init": -2.0,
            "covariance_rate": 1.3,
            "widening": 0.1,
        },
    },
)
# Where they travel, an action pays off some tenths of a second later; few arms, so that each sees many episodes. The
# critic's errors are as large as the returns, which plain gradient descent does not bear.
_PPO_TRAVELLING = Preset(
    num_envs=16,
    policy="natural",
    arguments={
        "n_steps": 256,
        "batch_size": 512,
        "n_epochs": 10,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 2e-3), (1.0, 0.0)),
        "clip_range": 0.2,
        "policy_kwargs": {
            "net_arch": [64, 64],
            "log_std_init": -1.5,
            "optimizer_class": "Adam",
        },
    },
)

# Damping and bias_rate keep the natural gradient from following what few states differ in.
_TRPO_TELEPORTING = Preset(
    num_envs=256,
    policy="natural",
    arguments={
        "n_steps": 2,
        "batch_size": 512,
        "gamma": 0.0,
        "learning_rate": 5e-3,
        "target_kl": 0.15,
        "cg_max_steps": 5,
        "cg_damping": 10.0,
        "n_critic_updates": 2,
        "policy_kwargs": {
            "net_arch": [64, 64],
            "log_std_init": -2.0,
            "covariance_rate": 1.2,
            "bias_rate": 10.0,
            "widening": 0.1,
        },
    },
)
_TRPO_TRAVELLING = Preset(
    num_envs=16,
    policy="natural",
    arguments={
        "n_steps": 256,
        "batch_size": 512,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": 1e-3,
        "target_kl": 0.02,
        "cg_damping": 0.01,
        "policy_kwargs": {
            "net_arch": [64, 64],
            "log_std_init": -1.5,
            "optimizer_class": "Adam",
        },
    },
)
_ACKTR_TELEPORTING = Preset(
    num_envs=64,
    arguments={
        "n_steps": 4,
        "gamma": 0.0,
        "learning_rate": ((0.0, 0.08), (1.0, 0.0)),
        "target_kl": 0.01,
        "critic_kl": 0.03,
        "damping": 0.006,
        "fisher_decay": 0.95,
        "momentum": 0.0,
        "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -2.0},
    },
)
_ACKTR_TRAVELLING = Preset(
    num_envs=16,
    arguments={
        "n_steps": 64,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 0.25), (1.0, 0.0)),
        "target_kl": 0.01,
        "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -1.5},
    },
)

# What ROS2Learn gave its algorithms (arXiv 1903.06282): 2048 steps an update, here from eight arms at once, and a standard
# deviation of 1 rad to begin with, which is 1/π of an action.
_PAPER_NETWORK = {"net_arch": [64, 64], "log_std_init": -math.log(math.pi)}
_PAPER = {
    "ppo": Preset(
        num_envs=8,
        arguments={
            "n_steps": 256,
            "batch_size": 512,
            "n_epochs": 10,
            "gamma": 0.99,
            "gae_lambda": 0.95,
            "learning_rate": ((0.0, 3e-3), (1.0, 0.0)),
            "clip_range": 0.25,
            "vf_coef": 1.0,
            "policy_kwargs": _PAPER_NETWORK,
        },
    ),
    "trpo": Preset(
        num_envs=8,
        arguments={
            "n_steps": 256,
            "batch_size": 64,
            "gamma": 0.99,
            "gae_lambda": 0.95,
            "learning_rate": 1e-3,
            "n_critic_updates": 5,
            # Stable-Baselines3 takes the mean over the joints where TRPO's divergence is their sum.
            "target_kl": 0.01 / 6,
            "cg_max_steps": 10,
            "cg_damping": 0.1,
            "policy_kwargs": _PAPER_NETWORK,
        },
    ),
    "acktr": Preset(
        num_envs=8,
        arguments={
            "n_steps": 256,
            "gamma": 0.99,
            "gae_lambda": 0.95,
            "learning_rate": ((0.0, 0.25), (1.0, 0.0)),
            "target_kl": 1e-3,
            "vf_coef": 0.5,
            "max_grad_norm": 0.5,
            "policy_kwargs": _PAPER_NETWORK,
        },
    ),
}

# Name → algorithm → for joints that teleport, and for joints that travel.
PRESETS: dict[str, dict[str, tuple[Preset, Preset]]] = {
    "tuned": {
        "ppo": (_PPO_TELEPORTING, _PPO_TRAVELLING),
        "trpo": (_TRPO_TELEPORTING, _TRPO_TRAVELLING),
        "acktr": (_ACKTR_TELEPORTING, _ACKTR_TRAVELLING),
    },
    "paper": {algorithm: (preset, preset) for algorithm, preset in _PAPER.items()},
}


def preset(algorithm: str, name: str = "tuned", *, teleports: bool) -> Preset:
    """An algorithm's preset for arms whose joints are at their targets at once, or travel there.

    Args:
        algorithm: its name.
        name: "tuned", each algorithm at its best, or "paper", what ROS2Learn gave all three.
        teleports: whether joints are at their targets at once.

    Raises:
        GymMaraError: there is no such algorithm or preset.
    """
    if name not in PRESETS:
        raise unknown("preset", name, PRESETS)
    if algorithm not in PRESETS[name]:
        raise unknown("algorithm", algorithm, PRESETS[name])
    teleporting, travelling = PRESETS[name][algorithm]
    return teleporting if teleports else travelling
