"""PPO: its presets and its search space."""

from dataclasses import replace

from gym_mara.agents.algorithms.base import Algorithm, LogRange, Preset, Presets, SearchSpace
from gym_mara.agents.algorithms.entries import PAPER_NETWORK

# Where joints teleport, the next state depends on the action alone, so future rewards are not discounted in (γ = 0).
# Many arms and short rollouts: once the tool is in place, the policy finds the angle by moving along a narrow curved
# valley, a fraction of its standard deviation per update. Many updates then matter more than accurate ones.
_TELEPORTING = Preset(
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
# Where joints travel, an action is rewarded some tenths of a second later. Few arms, so that each completes many episodes.
# The critic's errors are as large as the returns; plain gradient descent becomes unstable with them, hence Adam.
_TRAVELLING = Preset(
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
# Many arms with random targets, and many short updates. An action is rewarded within a second. The standard deviation begins
# wide, so that the arm finds ways around what is near.
_ANY_TARGET = Preset(
    num_envs=512,
    normalise_observation=True,
    arguments={
        "n_steps": 16,
        "batch_size": 2048,
        "n_epochs": 3,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "learning_rate": ((0.0, 1e-3), (1.0, 0.0)),
        "clip_range": 0.2,
        "policy_kwargs": {"net_arch": [256, 256], "log_std_init": -0.5, "activation_fn": "ReLU"},
    },
)
_PAPER = Preset(
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
        "policy_kwargs": PAPER_NETWORK,
    },
)


def _robust(tuned: Preset) -> Preset:
    """A tenth of the learning rate: for a policy that is trained further, with random arms, and must not forget what it can."""
    points = tuned.arguments["learning_rate"]
    rate = tuple((progress, 0.1 * value) for progress, value in points)
    return replace(tuned, arguments={**tuned.arguments, "learning_rate": rate})


ALGORITHM = Algorithm(
    name="ppo",
    summary="proximal policy optimisation, from Stable-Baselines3",
    target="stable_baselines3:PPO",
    presets={
        "tuned": Presets(_TELEPORTING, _TRAVELLING, {"any_target": _ANY_TARGET}),
        "paper": Presets(teleporting=_PAPER, travelling=_PAPER),
        "robust": Presets(
            _robust(_TELEPORTING), _robust(_TRAVELLING), {"any_target": _robust(_ANY_TARGET)}
        ),
    },
    search_space=SearchSpace(
        arguments={
            "n_steps": [1, 2, 4, 8],
            "batch_size": [256, 512],
            "n_epochs": [1, 2, 4],
            "learning_rate": LogRange(1e-2, 2e-1),
        },
        policy_kwargs={
            "covariance_rate": LogRange(0.5, 3.0),
            "widening": LogRange(0.02, 0.2),
        },
    ),
)
