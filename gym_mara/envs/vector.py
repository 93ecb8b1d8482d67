"""MaraVectorEnv: a batch of arms."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from gym_mara.arrays import host, is_tensor, namespace
from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.envs.given import GIVEN
from gym_mara.envs.options import Options, check_reset_options
from gym_mara.envs.outcome import Outcome
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.single import checked_render_mode
from gym_mara.envs.streams import Streams
from gym_mara.envs.view import first_view, view_of
from gym_mara.errors import GymMaraError, short, unknown, whole_number
from gym_mara.registration import environment
from gym_mara.rendering import Pictures
from gym_mara.robot import RobotLike
from gym_mara.tasks import Task
from gym_mara.types import Floats, Mask


class MaraVectorEnv(VectorEnv[Floats, NDArray[np.float32], NDArray[Any]]):
    """N arms in one batch: it gives the same results as N MaraEnvs in a fraction of the time.

    `info` has the keys of MaraEnv in Gymnasium's format for vector environments. `statistics` appear only at the last
    step of an episode. Keys with values of the same arms share one mask array.

    With a backend of tensors (`arrays="torch"`) actions, observations, rewards, flags, masks and all values of `info` are
    tensors on its device, and `final_obs` is one of shape (N, O). The spaces are Gymnasium's, so their samples are NumPy's.

    Args:
        num_envs: N.
        task, robot, ee_frame, backend, **options: as in MaraEnv.
        render_mode: "rgb_array" for pictures of every arm, or None.
        max_episode_steps: the number of steps after which an episode is truncated; None for no limit, and "default" for that of the
            environment with the name of the task, or of the task.
        autoreset_mode: Gymnasium's autoreset mode: "NextStep", "SameStep" or "Disabled".

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
        backend: str = DEFAULT_BACKEND,
        render_mode: str | None = None,
        max_episode_steps: int | Literal["default"] | None = "default",
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        self.closed = (
            True  # until the end of __init__: Gymnasium calls close() even if __init__ fails
        )
        self.render_mode = checked_render_mode(render_mode, ["rgb_array"])
        default = isinstance(max_episode_steps, str) and max_episode_steps == "default"
        if max_episode_steps is not None and not default:
            max_episode_steps = whole_number(
                "max_episode_steps", max_episode_steps, or_else="None for no limit"
            )
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        sorted_options = Options.sort(task, robot, ee_frame, backend, options, type(self))
        self.max_episode_steps = (
            self._episode_steps(task) if isinstance(max_episode_steps, str) else max_episode_steps
        )
        # From here on a thread may command an arm, so everything is checked before.
        self.simulation = self._make_simulation(sorted_options, num_envs)
        self.num_envs = self.simulation.num_envs
        self.single_observation_space = self.simulation.observation_space
        self.single_action_space = self.simulation.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": 1.0 / self.simulation.backend.control_period,
            "autoreset_mode": self.autoreset_mode,
        }
        self._pictures = Pictures(
            self.simulation.robot, sorted_options.rendering, first_view(self.simulation)
        )
        self._ended = self.simulation.backend.asarray(np.zeros(self.num_envs, dtype=np.bool_))
        # A copy of the last observations (N, O), which a reset with a mask returns for the other arms.
        self._last: Floats | None = None
        self.closed = False

    def _make_simulation(self, options: Options, num_envs: int) -> Simulation:
        return Simulation(options, num_envs)

    def _episode_steps(self, task: str | Task) -> int:
        """How long episodes are by default."""
        if isinstance(task, str):
            return environment(task).max_episode_steps
        return task.episode_steps

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin episodes of all arms, or of the arms that `options["reset_mask"]`, bool (N,), selects.

        The other arms keep their last observation. Further options are those of MaraEnv, for these episodes alone and not for
        those that follow in `step`: one value for all arms, such as a `target_position` (3,), or one for each (N, 3), of which
        the rows of other arms are not read. Checking a target takes about 10 ms.

        Raises:
            GymMaraError: the seeds, the mask or another option are not valid, as in MaraEnv. Nothing has changed then.
            ResetNeeded: the mask of the first reset leaves out arms, which would never have begun an episode.
        """
        check_reset_options(options, ["reset_mask", *GIVEN])
        seeds = self._seeds(seed)
        mask = (options or {}).get("reset_mask")
        if mask is not None:
            mask = self._checked(mask)
            if self._last is None and not bool(mask.all()):
                raise ResetNeeded(
                    "call reset() for all arms before you reset some of them by a mask"
                )
        given = self.simulation.episodes.given(options, mask)
        super().reset(seed=seeds[0])
        xp = namespace(self._ended)
        chosen = xp.ones_like(self._ended) if mask is None else mask
        self._ended = self._ended & ~chosen
        if self.simulation.random:
            self._seed(seeds, host(chosen))
        observation, report = self.simulation.reset(mask, given)
        if mask is not None and self._last is not None:
            observation = xp.where(mask[:, None], observation, self._last)
        self._last = xp.asarray(observation, copy=True)
        return self.simulation.present(observation), _vector_info(report, chosen)

    def _checked(self, mask: Any) -> Mask:
        """The mask of a reset, in the backend's arrays.

        Raises:
            GymMaraError: it is no mask, or selects no arm.
        """
        like = self._ended
        if not is_tensor(like):
            mask, where = host(mask), ""
        else:
            where = f" a tensor on {like.device},"
        if is_tensor(like) and not (is_tensor(mask) and mask.device == like.device):
            fits = False
        else:
            fits = mask.shape == like.shape and mask.dtype == like.dtype and bool(mask.any())
        if not fits:
            raise GymMaraError(
                f"reset_mask must be{where} bool, of shape {(self.num_envs,)}, and select at least one arm"
            )
        return mask

    def _seeds(self, seed: Any) -> list[int | None]:
        """The seed of each arm.

        Raises:
            GymMaraError: it is neither None, one whole number, nor a sequence of N of these.
        """
        seeds = seed
        if seed is None or isinstance(seed, (int, np.integer)):
            shift = range(self.num_envs)
            seeds = [None if seed is None else int(seed) + index for index in shift]
        if not isinstance(seeds, (list, tuple, np.ndarray)):
            raise GymMaraError(
                f"seed must be None, a whole number or a list of these, not {short(seed)}"
            )
        if len(seeds) != self.num_envs:
            raise GymMaraError(
                f"{len(seeds)} seeds for {self.num_envs} environments: give one seed per environment, or one int"
            )
        for each in seeds:
            if each is not None and not (isinstance(each, (int, np.integer)) and each >= 0):
                raise GymMaraError(
                    f"a seed must be None or a whole number of at least 0, not {short(each)}"
                )
        return [None if each is None else int(each) for each in seeds]

    def _seed(self, seeds: Sequence[int | None], chosen: Mask) -> None:
        """Set the streams of each arm to those of a MaraEnv with the arm's seed."""
        streams = dict(enumerate(self.simulation.streams))
        for index, seed in enumerate(seeds):
            if index not in streams or (chosen[index] and seed is not None):
                streams[index] = Streams.seeded(seed)
        self.simulation.streams = tuple(streams[index] for index in range(self.num_envs))

    def step(self, actions: ArrayLike) -> tuple[Floats, Floats, Mask, Mask, dict[str, Any]]:
        """Execute the actions (N, A) of all arms for one control period.

        With "NextStep" an arm whose episode has ended ignores its action and begins the next episode. If all have ended, no
        time passes.

        Raises:
            GymMaraError: the actions have the wrong type or shape, or are not finite, or an ended episode was not reset. No arm
                moves then.
        """
        resetting = self._ended
        xp = namespace(resetting)
        num_reset = int(xp.count_nonzero(resetting))
        if num_reset and self.autoreset_mode is AutoresetMode.DISABLED:
            raise GymMaraError(
                "episodes have ended: call reset(options={'reset_mask': …}) for them before the next step"
            )
        if num_reset == self.num_envs:
            return self._begin_all()
        outcome = self.simulation.step(actions)
        observation, reward, terminated = outcome.observation, outcome.reward, outcome.terminated
        limit = np.inf if self.max_episode_steps is None else self.max_episode_steps
        truncated = self.simulation.statistics.steps >= limit
        if outcome.truncated is not None:
            truncated |= outcome.truncated
        stepped = ~resetting
        if num_reset:  # NEXT_STEP: these arms begin an episode and ignore their action
            first, report = self.simulation.reset(resetting)
            observation = xp.where(resetting[:, None], first, observation)
            reward = xp.where(resetting, 0.0, reward)
            terminated, truncated = terminated & stepped, truncated & stepped
        info = _vector_info(outcome.info, stepped)
        if num_reset:
            _add_rows(info, report, resetting)
        ended = terminated | truncated
        if xp.count_nonzero(ended):
            info |= _vector_info({"statistics": self.simulation.statistics.summary()}, ended)
            if self.autoreset_mode is AutoresetMode.SAME_STEP:
                observation, info = self._begin_next(outcome, info, ended)
        if self.autoreset_mode is not AutoresetMode.SAME_STEP:
            self._ended = xp.asarray(ended, copy=True)
        self._last = xp.asarray(observation, copy=True)
        return self.simulation.present(observation), reward, terminated, truncated, info

    def _begin_all(self) -> tuple[Floats, Floats, Mask, Mask, dict[str, Any]]:
        """The step in which all arms begin their next episodes, for NEXT_STEP. A real arm gets no further command."""
        simulation, everyone = self.simulation, self._ended
        xp = namespace(everyone)
        # The keys of every other step, without values.
        info = _vector_info(simulation.judged(simulation.backend.state), ~everyone)
        observation, begun = simulation.reset(everyone)
        _add_rows(info, begun, everyone)
        self._ended = xp.zeros_like(everyone)
        self._last = xp.asarray(observation, copy=True)
        reward = xp.zeros_like(observation[:, 0])
        terminated, truncated = xp.zeros_like(everyone), xp.zeros_like(everyone)
        return simulation.present(observation), reward, terminated, truncated, info

    def _begin_next(
        self, outcome: Outcome, final: dict[str, Any], ended: Mask
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin the next episodes of the arms whose episodes have ended, for SAME_STEP.

        Args:
            outcome: the outcome of the step.
            final: the info of the step in Gymnasium's format, with the statistics.
            ended: the arms (N,).

        Returns:
            The observations (N, O), which for these arms are the first of their new episodes, and the info.
        """
        info = _vector_info(outcome.info, ~ended)
        info |= {"final_obs": self._final(outcome.observation, ended), "_final_obs": ended}
        final = {key: value for key, value in final.items() if key[0] != "_"}
        info |= _vector_info({"final_info": final}, ended)
        first, report = self.simulation.reset(ended)
        _add_rows(info, report, ended)
        return namespace(ended).where(ended[:, None], first, outcome.observation), info

    def _final(self, observation: Floats, ended: Mask) -> Any:
        """The observations of the ended arms: N objects of Gymnasium's format, or one tensor (N, O), zero for other arms."""
        if is_tensor(observation):
            final = _vector_info({"": observation}, ended)
            return self.simulation.present(final[""])
        last = np.full(self.num_envs, None, dtype=object)
        arms = np.flatnonzero(ended)
        shown = self.simulation.present(observation[arms], arms)
        for row, arm in enumerate(arms):
            if isinstance(shown, dict):
                last[arm] = {name: values[row] for name, values in shown.items()}
            else:
                last[arm] = shown[row]
        return last

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """Draw each arm in the state of its last observation: uint8 (height, width, 3), RGB; None without render_mode.

        Raises:
            MissingExtraError: no renderer is installed.
        """
        if self.render_mode is None:
            return None
        arms = range(self.num_envs)
        return tuple(self._pictures.of(view_of(self.simulation, arm)) for arm in arms)

    def save_state(self) -> dict[str, Any]:
        """A snapshot of the arms, the episodes and the random generators; it can be pickled."""
        return self.simulation.save() | {
            "ended": np.array(host(self._ended)),
            "last": None if self._last is None else np.array(host(self._last)),
            "np_random": copy.deepcopy(self.np_random),
        }

    def restore_state(self, snapshot: dict[str, Any]) -> None:
        """Restore a snapshot of an environment with the same arguments.

        Raises:
            GymMaraError: it is of another environment. Nothing has changed then.
        """
        last = snapshot.get("last") if isinstance(snapshot, dict) else None
        self.simulation.check_snapshot(
            snapshot,
            {
                "ended": host(self._ended),
                "last": type(None)
                if last is None
                else np.zeros((self.num_envs, *self.simulation.observation.space.shape)),
                "np_random": np.random.Generator,
            },
        )
        self.simulation.restore(snapshot)
        asarray = self.simulation.backend.asarray
        self._ended = asarray(snapshot["ended"].copy())
        self._last = None if last is None else asarray(last.copy())
        self.np_random = copy.deepcopy(snapshot["np_random"])

    def close_extras(self, **kwargs: Any) -> None:
        """Free the backend and the renderer; close() calls this method."""
        self._pictures.close()
        self.simulation.close()


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        raise unknown("autoreset_mode", mode, [m.value for m in AutoresetMode]) from None


def _vector_info(values: dict[str, Any], mask: Mask) -> dict[str, Any]:
    """Convert infos to Gymnasium's format for vector environments: the mask `_key` marks the arms that have a `key`."""
    info: dict[str, Any] = {}
    xp = namespace(mask)
    # A number of the host: a GPU would be waited for at each key.
    everyone = bool(xp.count_nonzero(mask) == len(mask))
    for key, value in values.items():
        if isinstance(value, dict):
            nested = {k: v for k, v in value.items() if not k.startswith("_")}
            info[key] = _vector_info(nested, mask)
        elif everyone:
            info[key] = value
        else:
            plain = value.dtype != object
            absent = (
                xp.zeros((), dtype=value.dtype, device=value.device) if plain else np.array(None)
            )
            info[key] = xp.where(_rows(mask, value), value, absent)
        info[f"_{key}"] = mask
    return info


def _add_rows(info: dict[str, Any], values: dict[str, NDArray[Any]], arms: Mask) -> None:
    """Add the values of some arms to an info that has the values of other arms."""
    for key, value in values.items():
        info[key] = namespace(arms).where(_rows(arms, value), value, info[key])
        info[f"_{key}"] = info[f"_{key}"] | arms


def _rows(mask: Mask, value: NDArray[Any]) -> Mask:
    """Reshape a mask (N,) so that it broadcasts with values (N, …)."""
    return mask.reshape(-1, *(1,) * (value.ndim - 1))
