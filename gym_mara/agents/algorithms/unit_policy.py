"""Policy networks that mark their actions in [-1, 1], so that an environment of joint targets refuses them."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy

from gym_mara.agents.scaling import is_unit_box
from gym_mara.types import UnitActions


class MarksUnitActions(BasePolicy):
    """A policy whose `predict` returns UnitActions if its actions are in [-1, 1]."""

    def predict(self, *args: Any, **kwargs: Any) -> tuple[Any, Any]:
        """As in Stable-Baselines3."""
        actions, state = super().predict(*args, **kwargs)
        return (actions.view(UnitActions) if is_unit_box(self.action_space) else actions), state

    def take_over(self, other: BasePolicy) -> None:
        """Become the policy of another network of the same form and size."""
        self.load_state_dict(other.state_dict())


class MlpPolicy(MarksUnitActions, ActorCriticPolicy):
    """The ActorCriticPolicy of Stable-Baselines3, its actions marked."""
