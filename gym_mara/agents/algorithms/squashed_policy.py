"""The networks of SAC and TQC: a Gaussian squashed by tanh, and critics. Their actions are marked, as in `unit_policy`."""

from __future__ import annotations

from sb3_contrib.tqc.policies import TQCPolicy
from stable_baselines3.sac.policies import SACPolicy

from gym_mara.agents.algorithms.unit_policy import MarksUnitActions


class SquashedPolicy(MarksUnitActions, SACPolicy):
    """The SACPolicy of Stable-Baselines3, its actions marked."""


class SquashedQuantilePolicy(MarksUnitActions, TQCPolicy):  # type: ignore[misc]
    """The TQCPolicy of sb3-contrib, whose critics learn quantiles of the return; its actions are marked."""
