"""Hyperparameters, apart from the code that uses them.

A preset says how many arms an agent trains on, what is normalised, and the arguments of the algorithm. Schedules are
written ("linear", start, end): from start at the first step to end at the last.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from gym_mara.errors import unknown

Schedule = tuple[str, float, float]


@dataclass(frozen=True)
class Preset:
    """How an algorithm trains on a task."""

    num_envs: int
    arguments: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the algorithm's class; see the module for schedules."""
    log_std: Schedule | None = None
    """The logarithm of the policy's standard deviation over the run; None where the algorithm learns it."""
    normalise_observation: bool = False
    normalise_reward: bool = False


_PPO_REACH = Preset(
    num_envs=256,
    arguments={
        "n_steps": 16,
        "batch_size": 1024,
        "n_epochs": 20,
        "gamma": 0.5,
        "gae_lambda": 0.95,
        "learning_rate": ("linear", 2e-3, 0.0),
        "clip_range": 0.2,
        "target_kl": 0.02,
        "policy_kwargs": {"net_arch": [64, 64], "log_std_init": -1.5},
    },
)

# Algorithm → task → preset; a task that is not named has that of "default".
PRESETS: dict[str, dict[str, Preset]] = {
    "ppo": {"default": _PPO_REACH},
}


def preset(algorithm: str, task: str) -> Preset:
    """The preset of an algorithm for a task.

    Raises:
        GymMaraError: there is no such algorithm.
    """
    if algorithm not in PRESETS:
        raise unknown("algorithm", algorithm, PRESETS)
    of_algorithm = PRESETS[algorithm]
    return of_algorithm.get(task, of_algorithm["default"])
