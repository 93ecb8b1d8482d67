"""A policy on disk: a folder with the model, and with a description of how it is used."""

from __future__ import annotations

import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import ArrayLike, NDArray
from pydantic import Field
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.vec_env import VecNormalize

from gym_mara.agents.algorithms.base import Preset, policy_class
from gym_mara.agents.runs.archive import read_weights
from gym_mara.agents.runs.config import DamagedRunError
from gym_mara.agents.runs.folder import RunFolder, versions
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.agents.scaling import Scaling, unit_box
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError, read_json, replace_folder, write_json, writing
from gym_mara.robot.fingerprint import fingerprint
from gym_mara.types import Floats

_FORBID: dict[str, Any] = {"extra": "forbid", "allow_inf_nan": False}
_Numbers = Annotated[list[float], Field(min_length=1, max_length=10_000)]


@dataclass(frozen=True)
class ObservationPart:
    """A named part of the observation."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID

    name: str
    size: Annotated[int, Field(ge=1, le=10_000)]


@dataclass(frozen=True)
class Normalisation:
    """How observations are normalised: (o - mean) / √(var + epsilon), clipped to ±clip."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID

    mean: _Numbers
    var: Annotated[list[Annotated[float, Field(ge=0.0)]], Field(min_length=1, max_length=10_000)]
    epsilon: Annotated[float, Field(gt=0.0)]
    clip: Annotated[float, Field(gt=0.0)]


@dataclass(frozen=True)
class PolicyDescription:
    """The content of policy.json: what a policy observes, and what its actions mean.

    Raises:
        GymMaraError: lengths differ, or a range is empty.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID

    format: Literal[1]
    joints: Annotated[list[str], Field(min_length=1, max_length=1000)]
    """The names of the joints, in the order of the actions."""
    low: _Numbers
    """The joint targets of the action -1, rad."""
    high: _Numbers
    """The joint targets of the action 1, rad."""
    observation: Annotated[list[ObservationPart], Field(min_length=1, max_length=1000)]
    """The parts of the observation, in order."""
    groups: dict[str, Annotated[int, Field(ge=1, le=10_000)]] | None
    """The sizes of the entries of an observation that is a dictionary; None for an array."""
    normalisation: Normalisation | None
    """None for observations that are not normalised."""
    robot: str
    """The fingerprint of the robot."""
    versions: dict[str, str]

    def __post_init__(self) -> None:
        if not len(self.joints) == len(self.low) == len(self.high):
            raise GymMaraError("'joints', 'low' and 'high' must have the same length")
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise GymMaraError("'low' must be below 'high'")
        if self.groups is not None and (
            self.normalisation or sum(self.groups.values()) != self.size
        ):
            raise GymMaraError(
                "'groups' must have the size of the observation, without normalisation"
            )
        if self.normalisation is not None:
            for values in (self.normalisation.mean, self.normalisation.var):
                if len(values) != self.size:
                    raise GymMaraError(f"the normalisation must have {self.size} numbers")

    @property
    def size(self) -> int:
        """O, the length of an observation."""
        return sum(part.size for part in self.observation)

    @property
    def layout(self) -> str:
        """The parts of the observation with their sizes, for messages."""
        return ", ".join(f"{part.name} ({part.size})" for part in self.observation)

    def check(self, simulation: Simulation, *, any_robot: bool = False) -> None:
        """Check that the policy can act in a simulation.

        Args:
            simulation: the simulation.
            any_robot: whether the robot may differ from the one of the training in more than its name.

        Raises:
            GymMaraError: the robot or the observation is another one.
        """
        robot = simulation.robot
        if robot.num_joints != len(self.joints):
            raise GymMaraError(
                f"the policy does not fit the environment: it moves {len(self.joints)} joints, "
                f"and {robot.name} has {robot.num_joints}"
            )
        if not any_robot and fingerprint(robot) != self.robot:
            raise GymMaraError(
                f"the robot {robot.name!r} has changed since the training, and the policy was trained for the old one: "
                "restore its files; or play the policy with the robot of today all the same, with --set robot=…"
            )
        parts = simulation.observation.parts
        layout = [ObservationPart(part.name, len(part.low)) for part in parts]
        if layout != self.observation or _groups(simulation) != self.groups:
            theirs = ", ".join(f"{part.name} ({part.size})" for part in layout)
            raise GymMaraError(
                f"the policy does not fit the environment: it observes {self.layout}, and the environment "
                f"has {theirs}"
            )


class Policy:
    """A trained policy: it observes the environment, and acts with joint targets.

    It has the `predict` of Stable-Baselines3's policies, so that `evaluate_policy` takes it. Scaling of actions and
    normalisation of observations are inside.
    """

    def __init__(self, network: ActorCriticPolicy, about: PolicyDescription) -> None:
        self.about = about
        self._network = network
        low, high = np.array(about.low), np.array(about.high)
        self._scaling = Scaling(low, high, unit_box(len(low)))
        normalisation = about.normalisation
        self._normalised = normalisation is not None
        if normalisation is not None:
            self._mean, self._clip = np.array(normalisation.mean), normalisation.clip
            self._deviation = np.sqrt(np.array(normalisation.var) + normalisation.epsilon)

    def predict(
        self,
        observation: ArrayLike | dict[str, NDArray[Any]],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[Floats, None]:
        """The joint targets (J,) or (N, J), rad, for an observation (O,) or a batch (N, O) of the environment.

        Args:
            observation: as the environment returns it, not normalised.
            state, episode_start: not used; the policy has no memory.
            deterministic: whether to take the most probable action, and not a random one.

        Raises:
            GymMaraError: the observation has another shape or is not finite.
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
        try:
            actions, _ = self._network.predict(observed, deterministic=deterministic)
        except RuntimeError as error:  # a matrix of the policy has no inverse
            raise DamagedRunError(f"the policy cannot compute an action: {error}") from error
        if not np.isfinite(actions).all():
            raise DamagedRunError("the policy's action is not finite: its weights are damaged")
        return self._scaling.targets(actions), None

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
        network = make_network(preset, space, unit_box(len(about.joints)))
        network.load_state_dict(weights)
    except (DamagedFileError, TypeError, ValueError, RuntimeError) as error:
        raise DamagedRunError(f"the policy in {str(folder)!r} is damaged: {error}") from error
    network.set_training_mode(False)
    return Policy(network, about)


def read_description(folder: Path) -> PolicyDescription:
    """The description of the policy in a folder.

    Raises:
        DamagedRunError: it is missing or damaged.
    """
    if (folder / "normalisation.json").exists():
        raise DamagedRunError(
            f"the policy in {str(folder)!r} is of an older version of gym_mara, which did not store what its actions "
            "mean: train it again"
        )
    try:
        return read_json(folder / "policy.json", PolicyDescription)
    except DamagedFileError as error:
        raise DamagedRunError(f"the policy in {str(folder)!r} is damaged: {error}") from error


def _box(size: int) -> Box:
    return Box(-np.inf, np.inf, (size,), np.float64)


def make_network(preset: Preset, observation: Space[Any], actions: Box) -> ActorCriticPolicy:
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
    if isinstance(observation, Dict):
        arguments["features_extractor_class"] = CombinedExtractor
    return arguments


def save_policy(
    folder: Path, model: OnPolicyAlgorithm, extra: dict[str, bytes] | None = None
) -> None:
    """Write the folder of a policy, with other files in it; after a kill the folder holds the old policy or the new one.

    Raises:
        GymMaraError: the folder cannot be written; then the old policy is unchanged.
    """
    temporary = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    try:
        with writing(folder):
            temporary.mkdir(parents=True)
            model.save(temporary / "model.zip")
            write_json(temporary / "policy.json", asdict(_description(model)))
            for name, content in (extra or {}).items():
                (temporary / name).write_bytes(content)
            replace_folder(temporary, folder)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _description(model: OnPolicyAlgorithm) -> PolicyDescription:
    wrapped, simulation = normalisation(model), base_env(model).env.simulation
    statistics = None
    if wrapped.norm_obs:
        running: Any = wrapped.obs_rms
        mean, var = running.mean.tolist(), running.var.tolist()
        statistics = Normalisation(mean, var, float(wrapped.epsilon), float(wrapped.clip_obs))
    return PolicyDescription(
        format=1,
        joints=list(simulation.robot.joint_names),
        low=simulation.action_space.low.tolist(),
        high=simulation.action_space.high.tolist(),
        observation=[ObservationPart(p.name, len(p.low)) for p in simulation.observation.parts],
        groups=_groups(simulation),
        normalisation=statistics,
        robot=fingerprint(simulation.robot),
        versions=versions(),
    )


def _groups(simulation: Simulation) -> dict[str, int] | None:
    """The sizes of the entries of an observation that is a dictionary."""
    space = simulation.observation_space
    if not isinstance(space, Dict):
        return None
    return {name: gymnasium.spaces.flatdim(entry) for name, entry in space.items()}


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
