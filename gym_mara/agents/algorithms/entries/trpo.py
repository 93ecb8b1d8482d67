"""TRPO: its presets and its search space."""

from gym_mara.agents.algorithms.base import Algorithm, LogRange, Preset, Presets, SearchSpace
from gym_mara.agents.algorithms.entries import PAPER_NETWORK

# `cg_damping` and `bias_rate` keep the natural gradient from following directions in which few states differ.
_TELEPORTING = Preset(
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
_TRAVELLING = Preset(
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
_ANY_TARGET = Preset(
    num_envs=512,
    normalise_observation=True,
    arguments={
        "n_steps": 16,
        "batch_size": 2048,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 1e-3), (1.0, 0.0)),
        "target_kl": 0.004,
        "cg_max_steps": 10,
        "cg_damping": 0.01,
        "n_critic_updates": 3,
        "policy_kwargs": {
            "net_arch": [256, 256],
            "log_std_init": -0.5,
            "activation_fn": "ReLU",
            "optimizer_class": "Adam",
        },
    },
)
_PAPER = Preset(
    num_envs=8,
    arguments={
        "n_steps": 256,
        "batch_size": 64,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "learning_rate": 1e-3,
        "n_critic_updates": 5,
        # Stable-Baselines3 averages the KL divergence over the six joints, where TRPO sums it.
        "target_kl": 0.01 / 6,
        "cg_max_steps": 10,
        "cg_damping": 0.1,
        "policy_kwargs": PAPER_NETWORK,
    },
)

ALGORITHM = Algorithm(
    name="trpo",
    summary="trust region policy optimisation, from sb3-contrib",
    target="sb3_contrib:TRPO",
    presets={
        "tuned": Presets(_TELEPORTING, _TRAVELLING, {"any_target": _ANY_TARGET}),
        "paper": Presets(teleporting=_PAPER, travelling=_PAPER),
    },
    search_space=SearchSpace(
        arguments={
            "n_steps": [1, 2, 4, 8],
            "target_kl": LogRange(2e-2, 2e-1),
            "cg_damping": LogRange(1.0, 100.0),
        },
        policy_kwargs={
            "covariance_rate": LogRange(0.3, 3.0),
            "bias_rate": [1.0, 3.0, 10.0, 30.0],
            "widening": LogRange(0.02, 0.2),
        },
    ),
)
