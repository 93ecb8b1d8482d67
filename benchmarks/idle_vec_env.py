"""An environment that does nothing, as Stable-Baselines3's VecEnv."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

Floats = NDArray[np.float64]
EPISODE = 2048


class IdleVecEnv(VecEnv):
    """Arms that do not move, with the spaces of another VecEnv."""

    def __init__(self, like: VecEnv) -> None:
        super().__init__(like.num_envs, like.observation_space, like.action_space)
        self._observation = np.zeros((like.num_envs, *(like.observation_space.shape or ())))
        self._steps = 0

    def reset(self) -> Floats:
        return self._observation.copy()

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._steps += 1

    def step_wait(self) -> Any:
        done = np.full(self.num_envs, self._steps % EPISODE == 0)
        infos: list[dict[str, Any]] = [
            {"terminal_observation": self._observation[0]} if d else {} for d in done
        ]
        rewards = np.zeros(self.num_envs, np.float32)
        return self._observation.copy(), rewards, done, infos

    def close(self) -> None:
        """Nothing to free."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [None] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise AttributeError(attr_name)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kw: Any) -> list[Any]:
        raise AttributeError(method_name)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        return [False] * self.num_envs
