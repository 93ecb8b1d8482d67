"""What SAC and TQC have in common: their presets and their search space."""

from typing import Any

from gym_mara.agents.algorithms.base import LogRange, Preset, Presets, SearchSpace

# Many arms fill the replay buffer in little time; an update costs far more than a step of all arms. So there are some
# updates for each step of all arms, with large batches, and the replay buffer holds the last 300,000 steps.
_COMMON: dict[str, Any] = {
    "buffer_size": 300_000,
    "batch_size": 256,
    "train_freq": 1,
    "gradient_steps": 2,
    "ent_coef": "auto_0.01",
    "policy_kwargs": {"net_arch": [128, 128]},
}
_TELEPORTING = _COMMON | {"learning_starts": 1000, "gamma": 0.0, "learning_rate": 1e-3}
_TRAVELLING = _COMMON | {
    "learning_starts": 2000,
    "gamma": 0.95,
    "tau": 0.01,
    "learning_rate": 7e-4,
}
_ANY_TARGET: dict[str, Any] = {
    "buffer_size": 1_000_000,
    "batch_size": 256,
    "train_freq": 1,
    "gradient_steps": 4,
    "learning_starts": 10_000,
    "gamma": 0.95,
    "tau": 0.01,
    "learning_rate": ((0.0, 1e-3), (1.0, 0.0)),
    "ent_coef": "auto_0.1",
    "policy_kwargs": {"net_arch": [128, 128]},
}

SEARCH_SPACE = SearchSpace(
    arguments={
        "gradient_steps": [1, 2, 4, 8],
        "batch_size": [128, 256, 512],
        "learning_rate": LogRange(1e-4, 3e-3),
        "tau": LogRange(2e-3, 5e-2),
    },
)


def tuned(policy: str) -> Presets:
    """The presets "tuned" with a policy network of this name."""
    return Presets(
        teleporting=Preset(num_envs=16, policy=policy, arguments=_TELEPORTING),
        travelling=Preset(num_envs=16, policy=policy, arguments=_TRAVELLING),
        families={
            "any_target": Preset(
                num_envs=128, policy=policy, normalise_observation=True, arguments=_ANY_TARGET
            )
        },
    )
