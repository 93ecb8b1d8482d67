"""The content of policy.json: what a policy observes, and what its actions mean."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from gymnasium.spaces import Dict, flatdim
from pydantic import Field

from gym_mara.agents.runs.config import DamagedRunError
from gym_mara.agents.runs.folder import versions
from gym_mara.backends import backend_settings
from gym_mara.deploy.about import action_keywords
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError
from gym_mara.files import read_json
from gym_mara.robot.fingerprint import fingerprint

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
class ActionDescription:
    """What the actions of an environment mean, in the terms of its keyword arguments `action`, `action_scale`, `action_from`."""

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID

    mode: Literal["absolute", "relative", "cartesian"]
    steps: Annotated[list[Annotated[float, Field(ge=0.0)]], Field(max_length=1000)]
    """What the action 1 means: a step of each joint, rad (m for a prismatic joint), or each component of a twist, m/s and rad/s;
    empty for absolute actions."""
    reference: Literal["position", "target"]
    """Where the steps begin."""

    @property
    def keywords(self) -> dict[str, Any]:
        """The keyword arguments of an environment with these actions."""
        return action_keywords(self.mode, self.steps, self.reference)


ABSOLUTE = ActionDescription("absolute", [], "position")
_FIRST_PERIOD = 0.02
"""The control period of policies in the first format, s."""


@dataclass(frozen=True)
class _Description:
    """What the formats share.

    Raises:
        GymMaraError: lengths differ, or a range is empty.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = _FORBID

    format: int
    joints: Annotated[list[str], Field(min_length=1, max_length=1000)]
    """The names of the joints, in the order of the robot's chain."""
    low: _Numbers
    """The lower bounds of the environment's actions, which the policy's -1 means."""
    high: _Numbers
    """The upper bounds, which the policy's 1 means."""
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
        if len(self.low) != len(self.high):
            raise GymMaraError("'low' and 'high' must have the same length")
        if not all(low <= high for low, high in zip(self.low, self.high, strict=True)):
            raise GymMaraError("'low' must not be above 'high'")
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


@dataclass(frozen=True)
class _FirstDescription(_Description):
    """The first format, of policies that act with absolute joint targets."""

    format: Literal[1]


@dataclass(frozen=True)
class PolicyDescription(_Description):
    """The content of policy.json: what a policy observes, and what its actions mean.

    Raises:
        GymMaraError: lengths differ, or a range is empty.
    """

    format: Literal[2]
    action: ActionDescription
    control_period: Annotated[float, Field(gt=0.0)]
    """How long a step lasted in the training, s."""

    def __post_init__(self) -> None:
        super().__post_init__()
        mode, steps = self.action.mode, len(self.action.steps)
        size = 6 if mode == "cartesian" else len(self.joints)
        if len(self.low) != size or steps != (0 if mode == "absolute" else size):
            raise GymMaraError(
                f"with {mode} actions of {len(self.joints)} joints 'low' and 'high' must have {size} numbers, and 'steps' "
                f"{0 if mode == 'absolute' else size}"
            )

    def check(self, simulation: Simulation, *, any_robot: bool = False) -> None:
        """Check that the policy can act in a simulation.

        Args:
            simulation: the simulation.
            any_robot: whether the robot may differ from the one of the training in more than its name.

        Raises:
            GymMaraError: the robot, the observation or the meaning of actions is another one.
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
        layout = _layout(simulation)
        if layout != self.observation or _groups(simulation) != self.groups:
            theirs = ", ".join(f"{part.name} ({part.size})" for part in layout)
            raise GymMaraError(
                f"the policy does not fit the environment: it observes {self.layout}, and the environment "
                f"has {theirs}"
            )
        self._check_action(simulation)

    def _check_action(self, simulation: Simulation) -> None:
        """Check that the actions of a simulation mean what the policy's do.

        Raises:
            GymMaraError: they do not.
        """
        own, theirs = self.action, _action(simulation)
        if own.mode != theirs.mode:
            raise GymMaraError(
                f"the policy does not fit the environment: its actions are {own.mode}, and those of the environment "
                f"{theirs.mode}: leave out action={theirs.mode!r}"
            )
        if own.reference != theirs.reference:
            raise GymMaraError(
                f"the policy does not fit the environment: its steps begin at the {own.reference}, and those of the environment "
                f"at the {theirs.reference}: leave out action_from={theirs.reference!r}"
            )
        if not np.allclose(own.steps, theirs.steps, rtol=1e-9, atol=0.0):
            raise GymMaraError(
                f"the policy does not fit the environment: its action 1 means {own.steps}, and that of the environment "
                f"{theirs.steps}: leave out action_scale"
            )

    def keywords(self, backend: str, options: dict[str, Any]) -> dict[str, Any]:
        """The keyword arguments of an environment in which the policy plays.

        Args:
            backend: the name of the backend.
            options: those of the policy's run or given by the user. The control period of the policy is added, and the steps
                that are made for it, but for absolute actions.
        """
        own = self.action
        if options.get("action", own.mode) != own.mode:
            return options  # `check` says what does not fit
        steps = {} if own.mode == "absolute" else own.keywords
        known = "control_period" in backend_settings(backend)
        period = {"control_period": self.control_period} if known else {}
        return steps | period | options


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
    form: Any = Annotated[_FirstDescription | PolicyDescription, Field(discriminator="format")]
    try:
        read = read_json(folder / "policy.json", form)
        if isinstance(read, PolicyDescription):
            return read
        second: dict[str, Any] = {"format": 2, "action": ABSOLUTE, "control_period": _FIRST_PERIOD}
        return PolicyDescription(**(vars(read) | second))
    except GymMaraError as error:
        raise DamagedRunError(f"the policy in {str(folder)!r} is damaged: {error}") from error


def described(simulation: Simulation, normalisation: Normalisation | None) -> PolicyDescription:
    """The description of a policy that was trained in a simulation, with actions in [-1, 1]."""
    return PolicyDescription(
        format=2,
        joints=list(simulation.robot.joint_names),
        low=simulation.action_space.low.tolist(),
        high=simulation.action_space.high.tolist(),
        observation=_layout(simulation),
        groups=_groups(simulation),
        normalisation=normalisation,
        robot=fingerprint(simulation.robot),
        versions=versions(),
        action=_action(simulation),
        control_period=simulation.backend.control_period,
    )


def _action(simulation: Simulation) -> ActionDescription:
    actions = simulation.actions
    reference: Any = actions.settings.action_from
    mode: Any = actions.mode
    return ActionDescription(mode, actions.steps.tolist(), reference)


def _layout(simulation: Simulation) -> list[ObservationPart]:
    return [ObservationPart(part.name, len(part.low)) for part in simulation.observation.parts]


def _groups(simulation: Simulation) -> dict[str, int] | None:
    """The sizes of the entries of an observation that is a dictionary."""
    space = simulation.observation_space
    if not isinstance(space, Dict):
        return None
    return {name: flatdim(entry) for name, entry in space.items()}
