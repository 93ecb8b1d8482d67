"""The content of policy.json: what a policy observes, and what its actions mean."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from gymnasium.spaces import Dict, flatdim
from pydantic import Field

from gym_mara.agents.runs.config import DamagedRunError
from gym_mara.agents.runs.folder import versions
from gym_mara.envs.simulation import Simulation
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError, read_json
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
        layout = _layout(simulation)
        if layout != self.observation or _groups(simulation) != self.groups:
            theirs = ", ".join(f"{part.name} ({part.size})" for part in layout)
            raise GymMaraError(
                f"the policy does not fit the environment: it observes {self.layout}, and the environment "
                f"has {theirs}"
            )


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


def described(simulation: Simulation, normalisation: Normalisation | None) -> PolicyDescription:
    """The description of a policy that was trained in a simulation, with actions in [-1, 1]."""
    return PolicyDescription(
        format=1,
        joints=list(simulation.robot.joint_names),
        low=simulation.action_space.low.tolist(),
        high=simulation.action_space.high.tolist(),
        observation=_layout(simulation),
        groups=_groups(simulation),
        normalisation=normalisation,
        robot=fingerprint(simulation.robot),
        versions=versions(),
    )


def _layout(simulation: Simulation) -> list[ObservationPart]:
    return [ObservationPart(part.name, len(part.low)) for part in simulation.observation.parts]


def _groups(simulation: Simulation) -> dict[str, int] | None:
    """The sizes of the entries of an observation that is a dictionary."""
    space = simulation.observation_space
    if not isinstance(space, Dict):
        return None
    return {name: flatdim(entry) for name, entry in space.items()}
