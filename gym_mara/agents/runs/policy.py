"""A trained policy: how it acts, and its folder with the model and policy.json."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import ArrayLike, NDArray
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import VecNormalize
from typing_extensions import Buffer

from gym_mara.agents.algorithms.base import Preset, policy_class
from gym_mara.agents.runs.archive import read_weights
from gym_mara.agents.runs.config import DamagedRunError
from gym_mara.agents.runs.description import (
    Normalisation,
    PolicyDescription,
    described,
    read_description,
)
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.agents.scaling import Scaling, unit_box
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError, replace_folder, write_json, writing
from gym_mara.types import Floats, UnitActions


class Policy:
    """A trained policy: it observes the environment and returns an action of it.

    It has the `predict` of Stable-Baselines3's policies, so that `evaluate_policy` takes it. Scaling of actions and
    normalisation of observations are inside. `about.action.keywords` makes an environment whose actions mean the same.
    A recurrent policy has a memory: play it with `begin`, or give `predict` the state that it returned, as
    `evaluate_policy` does.
    """

    def __init__(self, network: BasePolicy, about: PolicyDescription) -> None:
        self.about = about
        self._network = network
        self._recurrent = isinstance(network, RecurrentActorCriticPolicy)
        low, high = np.array(about.low), np.array(about.high)
        self._scaling = Scaling(low, high, unit_box(len(low)))
        normalisation = about.normalisation
        self._normalised = normalisation is not None
        if normalisation is not None:
            self._mean, self._clip = np.array(normalisation.mean), normalisation.clip
            self._deviation = np.sqrt(np.array(normalisation.var) + normalisation.epsilon)

    @property
    def network(self) -> BasePolicy:
        """The network of Stable-Baselines3, whose actions are in [-1, 1]."""
        return self._network

    def predict(
        self,
        observation: ArrayLike | dict[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Floats, Any]:
        """The action (A,) for an observation (O,) of the environment, or the actions (N, A) for a batch (N, O); and the state.

        Those of a policy that was trained with absolute actions are joint targets, rad; others are UnitActions, which an
        environment of joint targets refuses.

        Args:
            observation: as the environment returns it, not normalised.
            state: of a recurrent policy, as this method returned it with the last action; None at the beginning. Other policies
                ignore it, and return None.
            episode_start: of a recurrent policy, the arms (N,) whose episodes begin, and whose memory is cleared.
            deterministic: whether to take the most probable action, and not a random one.

        Raises:
            GymMaraError: the observation, or the state of a recurrent policy, has another shape or is not finite.
        """
        groups = self.about.groups
        observed: Any
        if groups is None:
            observed = self._checked(observation, self.about.size)
        elif isinstance(observation, dict) and observation.keys() == groups.keys():
            observed = {name: self._checked(observation[name], groups[name]) for name in groups}
        else:
            raise GymMaraError(
                f"the policy needs an observation that is a dictionary of {', '.join(groups)}"
            )
        if self._normalised:
            scaled = (observed - self._mean) / self._deviation
            observed = np.clip(scaled, -self._clip, self._clip).astype(np.float32)
        memory: dict[str, Any] = {}
        if self._recurrent:
            rows = next(iter(observed.values())) if isinstance(observed, dict) else observed
            memory = self._memory(state, episode_start, len(np.atleast_2d(rows)))
        try:
            actions, state = self._network.predict(observed, **memory, deterministic=deterministic)
        except RuntimeError as error:  # a matrix of the policy has no inverse
            raise DamagedRunError(f"the policy cannot compute an action: {error}") from error
        if not np.isfinite(actions).all():
            raise DamagedRunError("the policy's action is not finite: its weights are damaged")
        scaled = self._scaling.targets(actions)
        absolute = self.about.action.mode == "absolute"
        return (
            scaled if absolute else scaled.view(UnitActions),
            state if self._recurrent else None,
        )

    def begin(self, simulation: Simulation) -> Callable[[Any], Floats]:
        """What acts in the episodes of a simulation: the actions (N, A) for observations (N, O), deterministic.

        A recurrent policy remembers the steps of an episode, and forgets them when the next one begins.
        """
        state: Any = None

        def act(observation: Any) -> Floats:
            nonlocal state
            actions, state = self.predict(observation, state, simulation.statistics.steps == 0)
            return actions

        return act

    def _memory(self, state: Any, episode_start: Any, count: int) -> dict[str, Any]:
        """The state and the episode starts of N arms, as keyword arguments of the network.

        Raises:
            GymMaraError: they have another shape, or are not finite.
        """
        network: Any = self._network
        layers, _, size = network.lstm_hidden_state_shape
        shape = (layers, count, size)
        if state is not None and not (
            isinstance(state, tuple)
            and len(state) == 2
            and all(np.shape(each) == shape and np.isfinite(each).all() for each in state)
        ):
            raise GymMaraError(
                f"the state must be what predict returned for as many arms, two finite arrays {shape}; or None"
            )
        starts = (
            np.zeros(count, np.bool_) if episode_start is None else np.atleast_1d(episode_start)
        )
        if starts.shape != (count,):
            raise GymMaraError(f"episode_start must have the shape ({count},), not {starts.shape}")
        return {"state": state, "episode_start": starts}

    def _checked(self, observation: Any, size: int) -> Floats:
        try:
            observed = np.asarray(observation, np.float64)
        except (TypeError, ValueError) as error:
            raise GymMaraError(f"an observation must be an array of numbers: {error}") from error
        if observed.ndim not in (1, 2) or observed.shape[-1] != size or not observed.size:
            raise GymMaraError(
                f"the policy needs observations of shape ({size},) or (N, {size}), not {observed.shape}: "
                f"{self.about.layout}"
            )
        if not np.isfinite(observed).all():
            raise GymMaraError("the observation contains NaN or infinity")
        return observed

    def check(self, simulation: Simulation, *, any_robot: bool = False) -> None:
        """Check that the policy can act in a simulation; see `PolicyDescription.check`."""
        self.about.check(simulation, any_robot=any_robot)


def load_policy(run: RunFolder | Path | str, which: str = "last") -> Policy:
    """Load a policy of a run. Only numbers are read: nothing in the folder can run code.

    Args:
        run: the run or its folder.
        which: "last" or "best".

    Raises:
        DamagedRunError: a file is missing or damaged.
        GymMaraError: the run has no such policy.
    """
    run = run if isinstance(run, RunFolder) else RunFolder.open(Path(run))
    return read_policy(run.policy(which), run.config.made_preset())


def read_policy(folder: Path, preset: Preset) -> Policy:
    """The policy in a folder.

    Args:
        folder: the folder.
        preset: the preset with which it was trained.

    Raises:
        DamagedRunError: a file is missing or damaged, or does not fit the preset.
    """
    about = read_description(folder)
    space: Space[Any] = _box(about.size)
    if about.groups is not None:
        space = Dict({name: _box(size) for name, size in about.groups.items()})
    try:
        weights = read_weights(folder / "model.zip")
        network = make_network(preset, space, unit_box(len(about.low)))
        network.load_state_dict(weights)
    except (DamagedFileError, TypeError, ValueError, RuntimeError) as error:
        raise DamagedRunError(f"the policy in {str(folder)!r} is damaged: {error}") from error
    network.set_training_mode(False)
    return Policy(network, about)


def policy_of(model: BaseAlgorithm) -> Policy:
    """The policy of a model in training, as it would be loaded after `save_policy`."""
    about = described(base_env(model).env.simulation, _statistics(model))
    return Policy(model.policy, about)


def _box(size: int) -> Box:
    return Box(-np.inf, np.inf, (size,), np.float64)


def make_network(preset: Preset, observation: Space[Any], actions: Box) -> BasePolicy:
    """The untrained policy network of a preset."""
    make = policy_class(preset.policy)
    return make(observation, actions, lambda _: 0.0, **policy_arguments(preset, observation))


def policy_arguments(preset: Preset, observation: Space[Any]) -> dict[str, Any]:
    """The keyword arguments of a preset's policy network, for the observations of this space.

    Raises:
        GymMaraError: torch has no such optimiser.
    """
    arguments = dict(preset.arguments.get("policy_kwargs", {}))
    if (name := arguments.get("optimizer_class")) is not None:
        optimizer = getattr(torch.optim, name, None)
        if not (isinstance(optimizer, type) and issubclass(optimizer, torch.optim.Optimizer)):
            raise GymMaraError(f"torch.optim has no optimiser {name!r}")
        arguments["optimizer_class"] = optimizer
    if (name := arguments.get("activation_fn")) is not None:
        arguments["activation_fn"] = getattr(torch.nn, name)
    if isinstance(observation, Dict):
        arguments["features_extractor_class"] = CombinedExtractor
    return arguments


def save_policy(
    folder: Path, model: BaseAlgorithm, extra: Mapping[str, Iterable[Buffer]] | None = None
) -> None:
    """Write the folder of a policy; after a kill the folder holds the old policy or the new one.

    Args:
        folder: the folder.
        model: the agent.
        extra: other files to write there: name → the pieces of its content.

    Raises:
        GymMaraError: the folder cannot be written; then the old policy is unchanged.
    """
    temporary = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with writing(folder):
            temporary.mkdir(parents=True)
            model.save(temporary / "model.zip")
            about = described(base_env(model).env.simulation, _statistics(model))
            write_json(temporary / "policy.json", asdict(about))
            for name, pieces in (extra or {}).items():
                with (temporary / name).open("wb") as stream:
                    stream.writelines(pieces)
            replace_folder(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _statistics(model: BaseAlgorithm) -> Normalisation | None:
    """How a model's observations are normalised."""
    wrapped = normalisation(model)
    if not wrapped.norm_obs:
        return None
    running: Any = wrapped.obs_rms
    mean, var = running.mean.tolist(), running.var.tolist()
    return Normalisation(mean, var, float(wrapped.epsilon), float(wrapped.clip_obs))


def normalisation(model: Any) -> VecNormalize:
    """The normalisation around a model's environment; every agent here has one, even if it normalises nothing."""
    wrapped = model.get_vec_normalize_env()
    assert isinstance(wrapped, VecNormalize)
    return wrapped


def base_env(model: Any) -> MaraVecEnv:
    """The environment inside a model's normalisation."""
    env = normalisation(model).venv
    assert isinstance(env, MaraVecEnv)
    return env
