"""Environments that do nothing: the spaces of MARA-v0, observations of zeros, episodes of 2048 steps.

A training loop on them shows the cost of the library alone. Importing this module registers `idle/MARA-v0`; with the
prefix `idle:` other processes import it too.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

import gym_mara  # noqa: F401 - registers the environments

Floats = NDArray[np.float64]
EPISODE = 2048
_LIKE = gymnasium.make("gym_mara/MARA-v0")
_SPACES = _LIKE.observation_space, _LIKE.action_space


class IdleEnv(gymnasium.Env[Floats, NDArray[np.float32]]):
    """One arm that does not move."""

    def __init__(self) -> None:
        self.observation_space, self.action_space = _SPACES
        self._observation = np.zeros(_SPACES[0].shape or ())

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        super().reset(seed=seed)
        return self._observation.copy(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        return self._observation.copy(), 0.0, False, False, {}


class IdleVectorEnv(VectorEnv[Floats, NDArray[np.float32], NDArray[Any]]):
    """Many arms that do not move."""

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int = EPISODE,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
    ) -> None:
        self.num_envs, self._length = num_envs, max_episode_steps
        self.single_observation_space, self.single_action_space = _SPACES
        self.observation_space = batch_space(_SPACES[0], num_envs)
        self.action_space = batch_space(_SPACES[1], num_envs)
        self.autoreset_mode = AutoresetMode(autoreset_mode)  # where TorchRL looks for it
        self.metadata = {"autoreset_mode": self.autoreset_mode}
        self._observation = np.zeros(self.observation_space.shape or ())
        self._steps = np.zeros(num_envs, np.int64)

    def reset(
        self, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        self._steps[(options or {}).get("reset_mask", slice(None))] = 0
        return self._observation.copy(), {}

    def step(self, actions: Any) -> tuple[Floats, Floats, Any, Any, dict[str, Any]]:
        self._steps += 1
        ended = self._steps >= self._length
        info: dict[str, Any] = {}
        if ended.any() and self.metadata["autoreset_mode"] is not AutoresetMode.DISABLED:
            self._steps[ended] = 0
            if self.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP:
                final = np.full(self.num_envs, None, dtype=object)
                final[ended] = [self._observation[0].copy() for _ in range(int(ended.sum()))]
                info = {
                    "final_obs": final,
                    "_final_obs": ended,
                    "final_info": {},
                    "_final_info": ended,
                }
        never = np.zeros(self.num_envs, np.bool_)
        return self._observation.copy(), np.zeros(self.num_envs), never, ended, info


gymnasium.register(
    "idle/MARA-v0",
    entry_point="idle:IdleEnv",
    vector_entry_point="idle:IdleVectorEnv",
    max_episode_steps=EPISODE,
)
