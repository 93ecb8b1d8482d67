"""A policy network with a memory, for RecurrentPPO of sb3-contrib."""

from __future__ import annotations

from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy

from gym_mara.agents.algorithms.unit_policy import MarksUnitActions


class LstmPolicy(MarksUnitActions, RecurrentActorCriticPolicy):  # type: ignore[misc]
    """The RecurrentActorCriticPolicy of sb3-contrib, its actions marked: an LSTM, then a network, for actor and critic each."""
