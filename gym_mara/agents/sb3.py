"""A MaraVectorEnv as a VecEnv of Stable-Baselines3, without a Python object for each arm."""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, RescaleAction, TimeLimit
from numpy.typing import NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.types import Floats, Mask

_KNOWN_WRAPPERS = (OrderEnforcing, PassiveEnvChecker, RescaleAction, TimeLimit, Monitor)


class MaraVecEnv(VecEnv):
    """N arms for Stable-Baselines3; by default actions are in [-1, 1], scaled to each joint's range.

    The info of an arm is empty except at the end of its episode. There it holds `terminal_observation`,
    `TimeLimit.truncated`, the `episode` of a Monitor, and the info of MaraEnv at the last step.

    Args:
        env: the environment, with the autoreset mode SAME_STEP.
        action_space: the space of the actions (J,), scaled to that of the environment as `RescaleAction` does.

    Raises:
        GymMaraError: the environment has another autoreset mode.
    """

    def __init__(self, env: MaraVectorEnv, action_space: Box | None = None) -> None:
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise GymMaraError(
                "Stable-Baselines3 needs episodes that are reset in the same step: pass autoreset_mode='SameStep'"
            )
        self.env = env
        own = env.simulation.action_space
        space: Box = action_space or Box(-1.0, 1.0, own.shape, np.float32)
        if action_space is None:
            low, high = env.simulation.target_low, env.simulation.target_high
        else:
            low, high = own.low.astype(np.float64), own.high.astype(np.float64)
        super().__init__(env.num_envs, env.single_observation_space, space)
        self.metadata = env.metadata
        self._target_low, self._low = low, space.low.astype(np.float64)
        self._span = (high - low) / (space.high.astype(np.float64) - self._low)
        self._actions: NDArray[np.float32] = np.zeros((env.num_envs, *own.shape), np.float32)
        self._returns = np.zeros(env.num_envs)
        self._start = time.time()
        self.reward_sum = 0.0
        """The sum of all rewards since it was last set to zero."""

    def reset(self) -> Floats:
        seeds, self._returns = self._seeds, np.zeros(self.num_envs)
        observation, _ = self.env.reset(seed=seeds if seeds[0] is not None else None)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observation

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._actions = actions

    def targets(self, actions: NDArray[np.float32]) -> Floats:
        """The joint targets (N, J), rad, of actions (N, J)."""
        return self._target_low + self._span * (np.asarray(actions, np.float64) - self._low)

    def step_wait(
        self,
    ) -> tuple[Floats, NDArray[np.float32], Mask, list[dict[str, Any]]]:
        observation, reward, terminated, truncated, info = self.env.step(
            self.targets(self._actions)
        )
        self._returns += reward
        self.reward_sum += float(reward.sum())
        done = terminated | truncated
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done).tolist() if np.count_nonzero(done) else ():
            infos[index] = self._final_info(index, info)
            infos[index]["TimeLimit.truncated"] = bool(truncated[index] and not terminated[index])
            self._returns[index] = 0.0
        return observation, reward.astype(np.float32), done, infos

    def _final_info(self, index: int, info: dict[str, Any]) -> dict[str, Any]:
        final = info["final_info"]
        statistics = _at(final["statistics"], index)
        steps = int(statistics["ep_steps"])
        return {
            **_at({k: v for k, v in final.items() if k != "statistics"}, index),
            **statistics,
            "terminal_observation": info["final_obs"][index],
            "episode": {
                "r": float(self._returns[index]),
                "l": steps,
                "t": round(time.time() - self._start, 6),
            },
        }

    def save_state(self) -> dict[str, Any]:
        """A snapshot of the environment and of the running returns."""
        return {"env": self.env.save_state(), "returns": self._returns.copy()}

    def restore_state(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot."""
        self.env.restore_state(snapshot["env"])
        self._returns = snapshot["returns"].copy()

    def get_images(self) -> Sequence[NDArray[np.uint8] | None]:
        return self.env.render() or [None] * self.num_envs

    def close(self) -> None:
        self.env.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.env, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        chosen: Sequence[int] | Iterable[int] = self._get_indices(indices)
        result = getattr(self.env, method_name)(*method_args, **method_kwargs)
        return [result for _ in chosen]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


def in_one_batch(arms: VecEnv) -> VecEnv:
    """Turn the single environments of a DummyVecEnv into one MaraVecEnv, which steps them in a fraction of the time.

    Use it on the result of `make_vec_env`, or as the `vec_env_wrapper` of RL Baselines3 Zoo. The action space of a
    `RescaleAction` is kept. A Monitor around the first arm, with its file, becomes one around the batch. Environments in
    processes or in a viewer are returned unchanged.

    Raises:
        GymMaraError: the environments differ, are not made by `gymnasium.make`, or have a wrapper that a batch cannot keep.
    """
    if not isinstance(arms, DummyVecEnv) or arms.render_mode == "human":
        return arms
    specs = [env.spec for env in arms.envs]
    first, spec = arms.envs[0], specs[0]
    if spec is None or type(first.unwrapped) is not MaraEnv or len(set(map(repr, specs))) > 1:
        raise GymMaraError(
            "a batch needs equal environments, each a MaraEnv made by gymnasium.make, not "
            + ", ".join(sorted({str(env) for env in arms.envs}))
        )
    monitor: Monitor | None = None
    layer: Any = first
    while isinstance(layer, gymnasium.Wrapper):
        if not isinstance(layer, _KNOWN_WRAPPERS):
            raise GymMaraError(
                f"a batch cannot keep the wrapper {type(layer).__name__}: remove it; "
                f"allowed are {', '.join(sorted(w.__name__ for w in _KNOWN_WRAPPERS))}"
            )
        monitor = layer if isinstance(layer, Monitor) else monitor
        layer = layer.env
    batch: VecEnv = MaraVecEnv(
        MaraVectorEnv(
            arms.num_envs,
            **spec.kwargs,
            max_episode_steps=spec.max_episode_steps,
            autoreset_mode=AutoresetMode.SAME_STEP,
        ),
        cast(Box, arms.action_space),
    )
    batch._seeds = arms._seeds
    arms.close()
    if monitor is not None:
        writer = monitor.results_writer
        file = None if writer is None else writer.file_handler.name
        batch = VecMonitor(batch, file, monitor.info_keywords)
    return batch


def _at(values: dict[str, Any], index: int) -> dict[str, Any]:
    """The info of one arm from a batch of infos, as plain numbers, arrays and objects."""
    own = {k: v[index] for k, v in values.items() if not k.startswith("_")}
    return {k: v.item() if isinstance(v, np.generic) else v for k, v in own.items()}
