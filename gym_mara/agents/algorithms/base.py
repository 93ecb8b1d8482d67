"""What the registry says of an algorithm: its class, its presets and its search space, all as data and without torch."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple, TypeGuard

from gym_mara.errors import unknown

if TYPE_CHECKING:
    from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
    from stable_baselines3.common.policies import ActorCriticPolicy

POLICY_FORMS = {
    "mlp": "stable_baselines3.common.policies:ActorCriticPolicy",
    "natural": "gym_mara.agents.algorithms.natural_gaussian:NaturalGaussianPolicy",
}
"""The policy networks by name, each as "module:Class", imported when first used."""


def policy_class(form: str) -> type[ActorCriticPolicy]:
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
        GymMaraError: the policy is not one of POLICY_FORMS.
    """

    num_envs: int
    policy: str = "mlp"
    """The policy network, a name in POLICY_FORMS."""
    arguments: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the algorithm's class, as plain values.

    A value that changes during the run is a tuple of points (progress, value), connected by straight lines; the progress
    goes from 0 to 1. In `policy_kwargs`, `optimizer_class` is the name of a class in `torch.optim`.
    """
    normalise_observation: bool = False
    normalise_reward: bool = False

    def __post_init__(self) -> None:
        if self.policy not in POLICY_FORMS:
            raise unknown("policy", self.policy, POLICY_FORMS)


def is_schedule(value: Any) -> TypeGuard[Sequence[Sequence[float]]]:
    """Whether a preset's value is a tuple of points (progress, value), or the list that JSON makes of it."""
    return isinstance(value, (tuple, list)) and bool(value) and isinstance(value[0], (tuple, list))


class PresetPair(NamedTuple):
    """The presets of one name for the two ways in which a backend moves the joints."""

    teleporting: Preset
    """For joints that are at their targets after one step."""
    travelling: Preset
    """For joints that need several steps to reach their targets."""


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
    """An on-policy algorithm in the form of Stable-Baselines3."""

    name: str
    """Its name in `--algo`; figures and tables print it in capitals."""
    summary: str
    """What it is, in a few words, for `gym-mara list`."""
    target: str
    """The class as "module:Class", imported when first used."""
    presets: Mapping[str, PresetPair]
    """Name → presets; "tuned" is the default and must be among them."""
    search_space: SearchSpace

    def load_class(self) -> type[OnPolicyAlgorithm]:
        """The algorithm's class, its module imported."""
        return pkgutil.resolve_name(self.target)

    def preset_pair(self, name: str) -> PresetPair:
        """The presets of this name.

        Raises:
            GymMaraError: the algorithm has no such preset.
        """
        if name not in self.presets:
            raise unknown("preset", name, self.presets, f" of the algorithm {self.name!r}")
        return self.presets[name]

    def preset(self, name: str, *, teleports: bool) -> Preset:
        """The preset of this name for a backend whose joints teleport, or travel.

        Raises:
            GymMaraError: the algorithm has no such preset.
        """
        pair = self.preset_pair(name)
        return pair.teleporting if teleports else pair.travelling
