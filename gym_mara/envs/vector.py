"""MaraVectorEnv: many arms in one batch."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from gym_mara.envs.simulation import Mask, Simulation, report
from gym_mara.envs.single import checked_render_mode
from gym_mara.errors import GymMaraError, unknown, whole_number
from gym_mara.rendering import Pictures, RenderSettings
from gym_mara.robot import RobotLike
from gym_mara.tasks import Task

Floats = NDArray[np.float64]


class MaraVectorEnv(VectorEnv[Floats, NDArray[np.float32], NDArray[Any]]):
    """N arms in one batch: the numbers of N MaraEnvs, at a fraction of the time.

    `info` is MaraEnv's in Gymnasium's form for vectors, with `statistics` at the last step of an episode.

    Args:
        num_envs: N.
        task, robot, ee_frame, backend, **options: as in MaraEnv.
        render_mode: "rgb_array" for pictures of every arm, or None.
        max_episode_steps: the length of an episode, after which it is truncated; None for no end.
        autoreset_mode: Gymnasium's: "NextStep", "SameStep" or "Disabled".

    Raises:
        GymMaraError: a name is unknown, or a value is out of its range.
        MissingExtraError: a library is not installed.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str | Task = "MARA-v0",
        *,
        robot: RobotLike = "mara",
        ee_frame: str | None = None,
        backend: str = "pinocchio",
        render_mode: str | None = None,
        max_episode_steps: int | None = 2048,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        self.closed = True  # until it is whole: Gymnasium closes even what could not be made
        self.render_mode = checked_render_mode(render_mode, ["rgb_array"])
        if max_episode_steps is not None:
            max_episode_steps = whole_number("max_episode_steps", max_episode_steps)
        rendering, options = RenderSettings.split(options)
        others = RenderSettings.names()
        self.simulation = Simulation(task, num_envs, robot, ee_frame, backend, options, others)
        self.num_envs = self.simulation.num_envs
        self.single_observation_space = self.simulation.observation_space
        self.single_action_space = self.simulation.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.max_episode_steps = max_episode_steps
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": 1.0 / self.simulation.backend.control_period,
            "autoreset_mode": self.autoreset_mode,
        }
        self._pictures = Pictures(self.simulation.robot, rendering)
        self._ended = np.zeros(self.num_envs, dtype=np.bool_)
        self._generators: tuple[np.random.Generator, ...] = ()  # where episodes are random
        self.closed = False

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin episodes, of all arms or of those that `options["reset_mask"]`, bool (N,), names."""
        seeds: Sequence[int | None] = [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            seeds = [int(seed) + index for index in range(self.num_envs)]
        elif seed is not None:
            if len(seed) != self.num_envs:
                raise GymMaraError(f"{len(seed)} seeds for {self.num_envs} environments")
            seeds = seed
        super().reset(seed=seeds[0])
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            mask = np.asarray(mask)
            if mask.shape != (self.num_envs,) or mask.dtype != np.bool_ or not mask.any():
                raise GymMaraError(
                    f"reset_mask must be bool, of shape {(self.num_envs,)}, and choose at least one"
                )
        chosen = np.ones(self.num_envs, np.bool_) if mask is None else mask
        self._ended[chosen] = False
        if self.simulation.random:
            self._seed(seeds, chosen)
        observation = self.simulation.reset(self._generators, mask)
        return observation, _vector_info(report(self.simulation.backend.state), chosen)

    def _seed(self, seeds: Sequence[int | None], chosen: Mask) -> None:
        """Give each arm a random generator of its own, the one that a MaraEnv has with the arm's seed."""
        generators = dict(enumerate(self._generators))
        for index, seed in enumerate(seeds):
            if index not in generators or (chosen[index] and seed is not None):
                generators[index] = np_random(seed)[0]
        self._generators = tuple(generators[index] for index in range(self.num_envs))

    def step(self, actions: ArrayLike) -> tuple[Floats, Floats, Mask, Mask, dict[str, Any]]:
        """Move every arm towards its joint targets (N, J), rad, for one control period.

        Raises:
            GymMaraError: the actions have the wrong shape or are not finite; no arm has moved then.
        """
        return self.advance(actions, with_info=True)

    def advance(
        self, actions: ArrayLike, with_info: bool
    ) -> tuple[Floats, Floats, Mask, Mask, dict[str, Any]]:
        """`step`, by choice without an `info` but where an episode ends or begins: that spares a learner its making."""
        resetting = self._ended
        some_reset = bool(np.count_nonzero(resetting))
        if some_reset and self.autoreset_mode is AutoresetMode.DISABLED:
            raise GymMaraError(
                "episodes have ended: reset them, reset(options={'reset_mask': …}), before the next step"
            )
        outcome = self.simulation.step(actions)
        observation, reward, terminated = outcome.observation, outcome.reward, outcome.terminated
        truncated = self.simulation.statistics.steps == self.max_episode_steps
        if outcome.truncated is not None:
            truncated |= outcome.truncated
        if some_reset:  # NEXT_STEP: these began an episode instead of stepping
            observation[resetting] = self._reset(resetting)[resetting]
            reward[resetting] = 0.0
            terminated, truncated = terminated & ~resetting, truncated & ~resetting
        ended = terminated | truncated
        some_ended = bool(np.count_nonzero(ended))
        info: dict[str, Any] = {}
        if with_info or some_ended or some_reset:
            info = _vector_info(outcome.info, ~resetting)
        if some_reset:
            self._report_beginning(info, resetting)
        if some_ended:
            info |= _vector_info({"statistics": self.simulation.statistics.summary()}, ended)
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                final = np.full(self.num_envs, None, dtype=object)
                for index in np.flatnonzero(ended):
                    final[index] = observation[index].copy()
                final_info = {"final_info": {k: v for k, v in info.items() if k[0] != "_"}}
                info = _vector_info(outcome.info, ~ended)
                info |= {"final_obs": final, "_final_obs": ended.copy()}
                info |= _vector_info(final_info, ended)
                observation[ended] = self._reset(ended)[ended]
                self._report_beginning(info, ended)
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = ended.copy()
        return observation, reward, terminated, truncated, info

    def _reset(self, arms: Mask) -> Floats:
        return self.simulation.reset(self._generators, arms)

    def _report_beginning(self, info: dict[str, Any], began: Mask) -> None:
        """Enter what the backend says of arms whose episodes have just begun."""
        for key, values in report(self.simulation.backend.state).items():
            info[key][began] = values[began]
            info[f"_{key}"][began] = True

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture of each arm, of what its last observation shows; None without a render_mode.

        Raises:
            MissingExtraError: no renderer is installed.
        """
        if self.render_mode is None:
            return None
        return tuple(self._pictures.of(self.simulation.view(arm)) for arm in range(self.num_envs))

    def save_state(self) -> dict[str, Any]:
        """A snapshot of the arms, the episodes and the random generators; it pickles."""
        return self.simulation.save() | {
            "ended": self._ended.copy(),
            "np_random": copy.deepcopy(self.np_random),
            "generators": copy.deepcopy(self._generators),
        }

    def restore_state(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot of an environment made alike."""
        self.simulation.restore(snapshot)
        self._ended = snapshot["ended"].copy()
        self.np_random = copy.deepcopy(snapshot["np_random"])
        self._generators = copy.deepcopy(snapshot["generators"])

    def close_extras(self, **kwargs: Any) -> None:
        """Free the backend and the renderer; called by close()."""
        self._pictures.close()
        self.simulation.close()


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise unknown("autoreset_mode", mode, [m.value for m in AutoresetMode]) from None


def _vector_info(values: dict[str, Any], mask: Mask) -> dict[str, Any]:
    """Gymnasium's form of a batch of infos: a mask `_key` beside each key says which arms it speaks of."""
    info: dict[str, Any] = {}
    all_arms = np.count_nonzero(mask) == len(mask)
    for key, value in values.items():
        if isinstance(value, dict):
            nested = {k: v for k, v in value.items() if not k.startswith("_")}
            info[key] = _vector_info(nested, mask)
        elif all_arms:
            info[key] = value.copy()
        else:
            rows = mask.reshape(-1, *(1,) * (value.ndim - 1))
            absent = np.array(None) if value.dtype == object else np.zeros((), value.dtype)
            info[key] = np.where(rows, value, absent)
        info[f"_{key}"] = mask.copy()
    return info
