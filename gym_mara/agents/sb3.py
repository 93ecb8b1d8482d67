"""A MaraVectorEnv as a VecEnv of Stable-Baselines3, without a Python object for each arm."""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import Any, cast

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers import OrderEnforcing, PassiveEnvChecker, RescaleAction, TimeLimit
from numpy.typing import ArrayLike, NDArray
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor
from stable_baselines3.common.vec_env.base_vec_env import VecEnv

from gym_mara.agents.scaling import Scaling, is_unit_box
from gym_mara.envs import MaraEnv, MaraVectorEnv
from gym_mara.envs.options import check_reset_options
from gym_mara.errors import GymMaraError
from gym_mara.types import Floats, Mask, UnitActions

_KNOWN_WRAPPERS = (OrderEnforcing, PassiveEnvChecker, RescaleAction, TimeLimit, Monitor)


def require_numpy(env: MaraVectorEnv) -> None:
    """Check that an environment takes and gives NumPy's arrays, as Stable-Baselines3 does.

    Raises:
        GymMaraError: it takes and gives tensors.
    """
    if (arrays := env.simulation.backend.arrays) != "numpy":
        raise GymMaraError(
            f"Stable-Baselines3 and the policies of runs take NumPy's arrays: leave out arrays={arrays!r}"
        )


class MaraVecEnv(VecEnv):
    """N arms for Stable-Baselines3. Actions are those of the environment, or are scaled to them as `RescaleAction` does.

    The info of an arm is empty except at the end of its episode. There it holds `terminal_observation`,
    `TimeLimit.truncated`, the `episode` of a Monitor, and the info of MaraEnv at the last step.

    Args:
        env: the environment, with the autoreset mode SAME_STEP.
        action_space: the space of the actions (A,), such as `Box(-1, 1, (6,))`, whose bounds are scaled to those of the
            environment; by default the space of the environment, which is not scaled.

    Raises:
        GymMaraError: the environment has another autoreset mode or tensors, or the space has another shape or no bounds.
    """

    def __init__(self, env: MaraVectorEnv, action_space: Box | None = None) -> None:
        require_numpy(env)
        if env.autoreset_mode is not AutoresetMode.SAME_STEP:
            raise GymMaraError(
                "Stable-Baselines3 needs episodes that are reset in the same step: pass autoreset_mode='SameStep'"
            )
        self.env = env
        own = env.simulation.action_space
        space = own if action_space is None else action_space
        self._scaling = None if space == own else _scaling(env, space)
        self._unit = is_unit_box(space)
        super().__init__(env.num_envs, env.single_observation_space, space)
        self.metadata = env.metadata
        self._actions: NDArray[np.float32] = np.zeros((env.num_envs, *own.shape), np.float32)
        self._returns = np.zeros(env.num_envs)
        self._start = time.time()
        self.reward_sum = 0.0
        """The sum of all rewards since it was last set to zero."""

    def reset(self) -> Floats:
        for options in self._options:
            check_reset_options(options, [])
        seeds, self._returns = self._seeds, np.zeros(self.num_envs)
        observation, _ = self.env.reset(seed=seeds if seeds[0] is not None else None)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observation

    def step_async(self, actions: NDArray[np.float32]) -> None:
        self._actions = actions

    def targets(self, actions: ArrayLike) -> ArrayLike:
        """The actions of the environment (N, A) for actions (N, A) in `action_space`.

        Raises:
            GymMaraError: a policy's actions in [-1, 1] are not in the action space of this environment.
        """
        if self._scaling is None:
            return actions  # a policy's UnitActions too, which the environment refuses
        if isinstance(actions, UnitActions) and not self._unit:
            raise GymMaraError(
                f"the policy's actions are in [-1, 1], and those of this environment in {self.action_space}: "
                "make it with the action space of the policy"
            )
        return self._scaling.targets(actions)

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
        """The attribute for each of the arms; the spaces are those of one arm."""
        source = self if attr_name in ("observation_space", "action_space") else self.env
        return [getattr(source, attr_name) for _ in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Set an attribute of all arms.

        Raises:
            GymMaraError: the indices leave out arms.
        """
        self._check_all(self._chosen(indices), f"set the attribute {attr_name!r}")
        setattr(self.env, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the batch once; the list repeats its result for each arm. `render` gives each arm its picture.

        `compute_reward` of a goal environment changes nothing, so it may be called for some arms: HerReplayBuffer does so.

        Raises:
            GymMaraError: the indices leave out arms.
        """
        chosen = self._chosen(indices)
        if method_name == "render":
            pictures = self.get_images()
            return [pictures[index] for index in chosen]
        if method_name != "compute_reward":
            self._check_all(chosen, f"call {method_name!r}")
        return [getattr(self.env, method_name)(*method_args, **method_kwargs)] * len(chosen)

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Any = None) -> list[bool]:
        """Whether the arms behave as in this wrapper: true for Monitor, since the info has its `episode`."""
        return [wrapper_class is Monitor for _ in self._chosen(indices)]

    def _chosen(self, indices: Any) -> list[int]:
        """The indices of arms as a list: of None, an int, or a sequence, range or array of ints.

        Raises:
            GymMaraError: an index is not one of the arms.
        """
        if indices is None:
            return list(range(self.num_envs))
        array = np.atleast_1d(np.asarray(indices))
        whole = array.ndim == 1 and (array.dtype.kind in "iu" or array.size == 0)
        if not whole or ((array < 0) | (array >= self.num_envs)).any():
            raise GymMaraError(
                f"the indices of arms must be whole numbers from 0 to {self.num_envs - 1}, not {indices!r}"
            )
        return [int(index) for index in array]

    def _check_all(self, chosen: list[int], what: str) -> None:
        """Raises GymMaraError if the indices leave out arms."""
        if set(chosen) != set(range(self.num_envs)):
            raise GymMaraError(
                f"cannot {what} for the arms {chosen} alone: all {self.num_envs} arms are one batch. Give no indices, "
                "or use make_vec_env, which makes one environment for each arm"
            )


def _scaling(env: MaraVectorEnv, space: Box) -> Scaling:
    """The map from a space of actions to the joint targets of an environment.

    Raises:
        GymMaraError: the space has another shape or no bounds.
    """
    simulation = env.simulation
    if (
        not isinstance(space, Box)
        or space.shape != simulation.action_space.shape
        or not space.is_bounded()
        or not np.all(space.low < space.high)
    ):
        raise GymMaraError(
            f"action_space must be a bounded Box of shape {simulation.action_space.shape}, not {space}"
        )
    own = simulation.action_space
    return Scaling(own.low.astype(np.float64), own.high.astype(np.float64), space)


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
        with (
            warnings.catch_warnings()
        ):  # it replaces the statistics of the batch, which are the same
            warnings.filterwarnings("ignore", message=".*already wrapped with a `Monitor`")
            batch = VecMonitor(batch, file, monitor.info_keywords)
    return batch


def _at(values: dict[str, Any], index: int) -> dict[str, Any]:
    """The info of one arm from a batch of infos, as plain numbers, arrays and objects."""
    own = {k: v[index] for k, v in values.items() if not k.startswith("_")}
    return {k: v.item() if isinstance(v, np.generic) else v for k, v in own.items()}
