"""The metadata of an exported policy: what it observes, what its actions mean, and where it comes from.

They are one JSON object, the entry METADATA_KEY of the ONNX model's metadata. `docs/deploy.md` shows an example. This module
imports no library, because a robot's computer may have NumPy and onnxruntime alone.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import types
import typing
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, NoReturn

from gym_mara.errors import GymMaraError, one_of, short

METADATA_KEY = "gym_mara"
"""The name of the metadata's entry in the ONNX model."""
FORMAT = 1
"""The number of this form of the metadata; it changes if a reader of the old form could misunderstand the new one."""
OBSERVATION = "observation"
"""The name of the model's input if the observation is an array."""
ACTION = "action"
"""The name of the model's output."""
PACE = "pace"
"""The name of the observation's part by which steps are multiplied, if it has one."""
MODES = ("absolute", "relative", "cartesian")
REFERENCES = ("position", "target")


@dataclass(frozen=True)
class Joint:
    """A joint that the policy moves."""

    name: str
    unit: str
    """The unit of its position: "rad", or "m" for a prismatic joint."""
    lower: float
    """The lowest target: the robot's limit, or that of the environment's joint targets where it is narrower."""
    upper: float
    """The highest target."""
    velocity: float | None
    """Its highest velocity in the training, or the robot's limit if joints teleported, rad/s (m/s); None without a limit."""
    travel: float | None
    """How far a target is from the joint's position at most, rad (m): a farther one does not move it faster."""


@dataclass(frozen=True)
class Robot:
    """The robot."""

    name: str
    fingerprint: str
    """Equal for equal robots; see `gym_mara.robot.fingerprint`."""
    ee_frame: str
    """The end-effector link, whose pose is observed."""
    joints: tuple[Joint, ...]
    """In the order of the actions."""


@dataclass(frozen=True)
class Action:
    """What an action (A,) means.

    Absolute actions are joint targets, rad (m). The others are in [-1, 1]. A relative action is a step of each joint; with
    `reference` "position" it starts from where the joint is, and with "target" from the last target. A cartesian action is a
    twist of the end effector in the world frame: a linear velocity, then an angular one.
    """

    mode: str
    low: tuple[float, ...]
    """The lowest action (A,)."""
    high: tuple[float, ...]
    """The highest action (A,)."""
    steps: tuple[float, ...]
    """What the action 1 means (A,): a joint's step, rad (m), or a component of the twist, m/s and rad/s; empty if absolute."""
    reference: str

    @property
    def keywords(self) -> dict[str, Any]:
        """The keyword arguments of an environment with these actions."""
        return action_keywords(self.mode, self.steps, self.reference)


def action_keywords(mode: str, steps: Iterable[float], reference: str) -> dict[str, Any]:
    """The keyword arguments of an environment whose actions have this mode, these steps and this reference."""
    if mode == "absolute":
        return {"action": mode}
    return {"action": mode, "action_scale": list(steps), "action_from": reference}


@dataclass(frozen=True)
class Part:
    """A named part of the observation."""

    name: str
    size: int
    unit: str
    """Of its values, such as "m/s"; "joint" is the unit of each joint, "joint/s" that of its velocity, and "" none."""
    input: str
    """The model's input that it belongs to, in which the parts follow each other in the order of the list."""


@dataclass(frozen=True)
class Training:
    """Where the policy comes from."""

    algorithm: str
    preset: str
    steps: int
    """The steps of all arms together, up to the last checkpoint of the run."""
    seed: int
    policy: str
    """Which policy of the run: "last" or "best"."""
    backend: str
    env_options: dict[str, Any]
    """The keyword arguments of the environment; of a path only the last part."""


@dataclass(frozen=True)
class About:
    """The metadata of an exported policy.

    Raises:
        GymMaraError: values contradict each other.
    """

    format: int
    gym_mara: str
    """The version of gym_mara that exported the policy."""
    env: str
    """The name of the environment."""
    target: str | None
    """What the policy reaches for: a "position" or a "pose"; None if the task is another one."""
    control_period: float
    """The time between two actions, s."""
    robot: Robot
    action: Action
    observation: tuple[Part, ...]
    training: Training

    def __post_init__(self) -> None:
        joints, action = self.robot.joints, self.action
        one_of("action mode", action.mode, MODES)
        one_of("reference of actions", action.reference, REFERENCES)
        size = 6 if action.mode == "cartesian" else len(joints)
        steps = 0 if action.mode == "absolute" else size
        if not joints or (len(action.low), len(action.high), len(action.steps)) != (
            size,
            size,
            steps,
        ):
            raise GymMaraError(
                "the joints and the bounds and steps of the actions do not fit together"
            )
        ranges = [*zip(action.low, action.high, strict=True), *((j.lower, j.upper) for j in joints)]
        if not all(low <= high for low, high in ranges):
            raise GymMaraError("a lower bound is above the upper one")
        limits = [limit for j in joints for limit in (j.velocity, j.travel) if limit is not None]
        if not all(value > 0.0 for value in (self.control_period, *limits)):
            raise GymMaraError("the control period, velocities and travels must be positive")
        if min(action.steps, default=0.0) < 0.0:
            raise GymMaraError("the steps of actions must not be negative")
        if not self.observation or not all(part.size > 0 for part in self.observation):
            raise GymMaraError("an observation must have parts, each with at least one value")

    @property
    def inputs(self) -> dict[str, int]:
        """The sizes of the model's inputs by name; if there are several, an observation is a dictionary of arrays."""
        sizes: dict[str, int] = {}
        for part in self.observation:
            sizes[part.input] = sizes.get(part.input, 0) + part.size
        return sizes

    @property
    def layout(self) -> str:
        """The parts of the observation with their sizes, for messages."""
        return ", ".join(f"{part.name} ({part.size})" for part in self.observation)

    def to_json(self) -> str:
        """The metadata as JSON."""
        return json.dumps(dataclasses.asdict(self), allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> About:
        """Read the metadata.

        Raises:
            GymMaraError: the text is not JSON, its format is another one, or a value is missing, unknown or of another type.
        """
        try:
            values = json.loads(text, parse_constant=_not_finite)
        except (ValueError, RecursionError) as error:
            raise GymMaraError(f"the metadata are not JSON: {error}") from None
        number = values.get("format") if isinstance(values, dict) else None
        if number != FORMAT:
            raise GymMaraError(
                f"the metadata have the format {short(number)}, and this version of gym_mara reads {FORMAT}: use the version "
                "that exported the policy, or export it again"
            )
        return typing.cast(About, _read(cls, values, "the metadata"))


def _not_finite(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a finite number")


def _read(form: Any, value: Any, where: str) -> Any:
    """A value of JSON as this type: a dataclass, a tuple of one type, a dict, a union, or a plain type.

    Raises:
        GymMaraError: it has another type.
    """
    origin, arguments = typing.get_origin(form), typing.get_args(form)
    if dataclasses.is_dataclass(form) and isinstance(value, dict):
        fields = typing.get_type_hints(form)
        for name in value.keys() ^ fields.keys():
            raise GymMaraError(f"{where}: {name!r} is {'unknown' if name in value else 'missing'}")
        return form(**{n: _read(f, value[n], f"{where}.{n}") for n, f in fields.items()})  # type: ignore[operator]
    if origin is tuple and isinstance(value, list):
        return tuple(_read(arguments[0], v, f"{where}[{i}]") for i, v in enumerate(value))
    if origin is types.UnionType:
        return None if value is None else _read(arguments[0], value, where)
    if form is float and type(value) in (int, float) and abs(value) <= sys.float_info.max:
        return float(value)
    if form is not float and type(value) is (origin or form):
        return value
    name = getattr(form, "__name__", form)
    raise GymMaraError(f"{where} must be of the type {name}, not {short(value)}")
