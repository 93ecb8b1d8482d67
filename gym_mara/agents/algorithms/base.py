"""What the registry says of an algorithm: its class, its presets and its search space, all as data and without torch."""

from __future__ import annotations

import math
import pkgutil
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeGuard

from gym_mara.errors import GymMaraError, short, unknown

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm

    from gym_mara.agents.algorithms.unit_policy import MarksUnitActions

POLICY_FORMS = {
    "mlp": "gym_mara.agents.algorithms.unit_policy:MlpPolicy",
    "lstm": "gym_mara.agents.algorithms.lstm_policy:LstmPolicy",
    "natural": "gym_mara.agents.algorithms.natural_gaussian:NaturalGaussianPolicy",
    "sac": "gym_mara.agents.algorithms.squashed_policy:SquashedPolicy",
    "tqc": "gym_mara.agents.algorithms.squashed_policy:SquashedQuantilePolicy",
}
"""The policy networks by name, each as "module:Class", imported when first used."""
_WITH_Q = ("sac", "tqc")
"""The networks whose critics are functions of state and action."""


def policy_class(form: str) -> type[MarksUnitActions]:
    """The class of the policy network of this name.

    Raises:
        GymMaraError: there is no such policy.
    """
    if form not in POLICY_FORMS:
        raise unknown("policy", form, POLICY_FORMS)
    return pkgutil.resolve_name(POLICY_FORMS[form])


@dataclass(frozen=True)
class Preset:
    """Hyperparameters of an algorithm: how many arms it trains on, what is normalised, and its arguments.

    Raises:
        GymMaraError: the policy is not one of POLICY_FORMS, or a value is unknown or out of its range.
    """

    __pydantic_config__: ClassVar[dict[str, Any]] = {"extra": "forbid"}

    num_envs: int
    policy: str = "mlp"
    """The policy network, a name in POLICY_FORMS."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the algorithm's class, as plain values.

    A value that changes during the run is a tuple of points (progress, value), connected by straight lines; the progress
    goes from 0 to 1. `ent_coef` of SAC and TQC may be "auto" or "auto_" with its first value. In `policy_kwargs`, `optimizer_class` is the name of a class in `torch.optim`, and `activation_fn`
    is one of ACTIVATIONS.
    """
    normalise_observation: bool = False
    normalise_reward: bool = False

    def __post_init__(self) -> None:
        if self.policy not in POLICY_FORMS:
            raise unknown("policy", self.policy, POLICY_FORMS)
        steps = self.arguments.get("n_steps", 1)
        if type(steps) is not int or steps < 1:
            raise GymMaraError(f"n_steps must be a whole number of at least 1, not {short(steps)}")
        if not 1 <= self.num_envs <= _MOST_ARMS or self.num_envs * steps > _LARGEST_ROLLOUT:
            raise GymMaraError(
                f"a preset has 1 to {_MOST_ARMS} arms, and at most {_LARGEST_ROLLOUT} steps in a rollout, "
                f"not {short(self.num_envs)} arms with {short(steps)} steps each"
            )
        size = self.arguments.get("buffer_size", 1)
        if type(size) is not int or not 1 <= size <= _LARGEST_BUFFER:
            raise GymMaraError(
                f"buffer_size must be a whole number from 1 to {_LARGEST_BUFFER:,}, not {short(size)}"
            )
        policy = self.arguments.get("policy_kwargs", {})
        others = {name: v for name, v in self.arguments.items() if name != "policy_kwargs"}
        if isinstance(start := others.get("ent_coef"), str) and _LEARNT.fullmatch(start):
            del others["ent_coef"]
        for name, value in others.items():
            points = value if is_schedule(value) else [(0.0, value)]
            if any(len(point) != 2 for point in points) or not all(
                _is_number(number) or number is None for point in points for number in point
            ):
                raise GymMaraError(
                    f"the argument {name!r} must be a number or points (progress, value), not {short(value)}"
                )
        _check_policy(policy, "qf" if self.policy in _WITH_Q else "vf")


_MOST_ARMS = 2**16
_LARGEST_ROLLOUT = 2**22
_LARGEST_BUFFER = 2**21
_LEARNT = re.compile(r"auto(_(0\.[0-9]*[1-9]|[1-9][0-9]*(\.[0-9]+)?))?")
"""An entropy coefficient that is learnt, with or without its first value."""
_LARGEST_WHOLE = 10**12
_NETWORK = (6, 1024)
"""The most layers of a network, and the most units of a layer."""
ACTIVATIONS = ("ReLU", "Tanh", "ELU", "SiLU", "GELU", "LeakyReLU")
"""The activation functions of a network, each a class in `torch.nn`."""
_POLICY_NUMBERS = ("log_std_init", "ortho_init", "covariance_rate", "bias_rate", "widening")
_POLICY_COUNTS = {"n_critics": 8, "n_quantiles": 128, "lstm_hidden_size": 1024, "n_lstm_layers": 4}
"""The whole numbers among the arguments of a network, each with its largest value."""


def _check_policy(values: Any, critic: str) -> None:
    """Raises GymMaraError if the arguments of a policy network are not valid; `critic` is the name of its critic."""
    if not isinstance(values, dict):
        raise GymMaraError(f"policy_kwargs must be a dict, not {short(values)}")
    layers, units = _NETWORK
    for name, value in values.items():
        if name == "net_arch":
            nets = list(value.values()) if isinstance(value, dict) else [value]
            if (isinstance(value, dict) and set(value) - {"pi", critic}) or not all(
                isinstance(net, (list, tuple))
                and len(net) <= layers
                and all(type(size) is int and 1 <= size <= units for size in net)
                for net in nets
            ):
                raise GymMaraError(
                    f"net_arch must be a list of at most {layers} sizes from 1 to {units}, or such lists "
                    f"by the names 'pi' and {critic!r}, not {short(value)}"
                )
        elif name == "activation_fn":
            if value not in ACTIVATIONS:
                raise unknown("activation function", value, ACTIVATIONS)
        elif name == "optimizer_class":
            if not isinstance(value, str) or not value.isidentifier():
                raise GymMaraError(
                    f"optimizer_class must be the name of an optimiser, not {short(value)}"
                )
        elif name in _POLICY_COUNTS:
            if type(value) is not int or not 1 <= value <= _POLICY_COUNTS[name]:
                raise GymMaraError(
                    f"{name} must be a whole number from 1 to {_POLICY_COUNTS[name]}, not {short(value)}"
                )
        elif name not in _POLICY_NUMBERS:
            valid = [
                "net_arch",
                "activation_fn",
                "optimizer_class",
                *_POLICY_COUNTS,
                *_POLICY_NUMBERS,
            ]
            raise unknown("argument of the policy", name, valid)
        elif not _is_number(value):
            raise GymMaraError(f"{name} must be a finite number, not {short(value)}")


def _is_number(value: Any) -> bool:
    if isinstance(value, int):
        return abs(value) <= _LARGEST_WHOLE
    return isinstance(value, float) and math.isfinite(value)


def plain_values(name: str, value: Any, depth: int = 0) -> None:
    """Check that a value can stand in a run's configuration: texts, finite numbers, lists and dicts of them.

    Raises:
        GymMaraError: it cannot.
    """
    if isinstance(value, dict) and depth < _DEEPEST:
        for key, each in value.items():
            if not isinstance(key, str):
                raise GymMaraError(f"{name} has the key {short(key)}; keys must be texts")
            plain_values(f"{name}[{key!r}]", each, depth + 1)
    elif isinstance(value, (list, tuple)) and depth < _DEEPEST:
        for each in value:
            plain_values(name, each, depth + 1)
    elif not (value is None or isinstance(value, str) or _is_number(value)):
        raise GymMaraError(
            f"{name} must consist of texts, finite numbers, lists and dicts, so that a run can store it; "
            f"it has {short(value)}"
        )


_DEEPEST = 8
"""The most levels of nested lists and dicts."""


def is_schedule(value: Any) -> TypeGuard[Sequence[Sequence[float]]]:
    """Whether a preset's value is a tuple of points (progress, value), or the list that JSON makes of it."""
    return isinstance(value, (tuple, list)) and bool(value) and isinstance(value[0], (tuple, list))


class Presets(NamedTuple):
    """The presets of one name, for the ways in which a backend moves the joints and for families of tasks."""

    teleporting: Preset
    """For joints that are at their targets after one step, and actions that are joint targets."""
    travelling: Preset
    """For joints that need several steps to reach their targets, and for other actions."""
    families: Mapping[str, Preset] = MappingProxyType({})
    """`Task.preset_family` → the preset for these tasks on every backend; the two above are for all other tasks."""

    def choose(self, *, teleports: bool, family: str = "") -> Preset:
        """The preset for a backend whose joints teleport, or travel, and a family of tasks."""
        return self.families.get(family) or (self.teleporting if teleports else self.travelling)


class LogRange(NamedTuple):
    """A range of positive numbers that a search samples on a logarithmic scale."""

    low: float
    high: float


Values = LogRange | Sequence[Any]
"""The values of a hyperparameter in a search: a range, or a list of choices."""


@dataclass(frozen=True)
class SearchSpace:
    """The hyperparameters that `gym-mara search` varies, starting from the tuned preset for teleporting joints."""

    arguments: Mapping[str, Values]
    """Of the algorithm's class; one that is a schedule in the preset is scaled to start at the value."""
    policy_kwargs: Mapping[str, Values] = field(default_factory=dict)
    """Of the policy network."""


@dataclass(frozen=True)
class Algorithm:
    """An on-policy or off-policy algorithm in the form of Stable-Baselines3."""

    name: str
    """Its name in `--algo`; figures and tables print it in capitals."""
    summary: str
    """What it is, in a few words, for `gym-mara list`."""
    target: str
    """The class as "module:Class", imported when first used."""
    presets: Mapping[str, Presets]
    """Name → presets; "tuned" is the default and must be among them."""
    search_space: SearchSpace

    def load_class(self) -> type[BaseAlgorithm]:
        """The algorithm's class, its module imported."""
        return pkgutil.resolve_name(self.target)

    def presets_of(self, name: str) -> Presets:
        """The presets of this name.

        Raises:
            GymMaraError: the algorithm has no such preset.
        """
        if name not in self.presets:
            raise unknown("preset", name, self.presets, f" of the algorithm {self.name!r}")
        return self.presets[name]

    def preset(self, name: str, *, teleports: bool, family: str = "") -> Preset:
        """The preset of this name for a backend whose joints teleport, or travel, and a family of tasks.

        Raises:
            GymMaraError: the algorithm has no such preset.
        """
        return self.presets_of(name).choose(teleports=teleports, family=family)
