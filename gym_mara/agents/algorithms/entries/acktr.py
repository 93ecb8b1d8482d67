"""ACKTR: its presets and its search space."""

from gym_mara.agents.algorithms.base import Algorithm, LogRange, Preset, Presets, SearchSpace
from gym_mara.agents.algorithms.entries import PAPER_NETWORK

_TELEPORTING = Preset(
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
_TRAVELLING = Preset(
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
_ANY_TARGET = Preset(
    num_envs=512,
    normalise_observation=True,
    arguments={
        "n_steps": 16,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 0.25), (1.0, 0.0)),
        "target_kl": 0.01,
        "policy_kwargs": {"net_arch": [256, 256], "log_std_init": -0.5, "activation_fn": "ReLU"},
    },
)
_PAPER = Preset(
    num_envs=8,
    arguments={
        "n_steps": 256,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 0.25), (1.0, 0.0)),
        "target_kl": 1e-3,
        "vf_coef": 0.5,
        "max_grad_norm": 0.5,
        "policy_kwargs": PAPER_NETWORK,
    },
)

ALGORITHM = Algorithm(
    name="acktr",
    summary="actor-critic using Kronecker-factored trust region, our own",
    target="gym_mara.agents.algorithms.acktr:ACKTR",
    presets={
        "tuned": Presets(_TELEPORTING, _TRAVELLING, {"any_target": _ANY_TARGET}),
        "paper": Presets(teleporting=_PAPER, travelling=_PAPER),
    },
    search_space=SearchSpace(
        arguments={
            "n_steps": [1, 2, 4, 8],
            "learning_rate": LogRange(1e-2, 1.0),
            "target_kl": LogRange(3e-4, 3e-2),
            "critic_kl": LogRange(3e-2, 1.0),
            "damping": LogRange(1e-3, 1e-1),
            "fisher_decay": [0.9, 0.95, 0.99],
            "momentum": [0.0, 0.5, 0.9],
        },
        policy_kwargs={"log_std_init": [-2.0, -1.5, -1.0]},
    ),
)
