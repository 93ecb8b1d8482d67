"""The actions of a straight joint move."""

from __future__ import annotations

from typing import Any

import numpy as np

from gym_mara.envs.actions.base import AbsoluteActions
from gym_mara.envs.actions.steps import RelativeActions
from gym_mara.errors import GymMaraError
from gym_mara.types import Floats


class StraightActions:
    """Moves N arms straight to configurations, at the joints' velocity limits. All joints arrive together.

    It knows the true joint positions, also where sensors are noisy.

    Args:
        simulation: the `gym_mara.envs.simulation.Simulation` of the arms.

    Raises:
        GymMaraError: the actions are not those of joints.
    """

    def __init__(self, simulation: Any) -> None:
        if not isinstance(simulation.actions, (AbsoluteActions, RelativeActions)):
            raise GymMaraError(
                f"a straight joint move has no {simulation.actions.mode} actions: give action=relative or action=absolute"
            )
        self._simulation, backend = simulation, simulation.backend
        # How far ahead of a joint its target must be for the joint to move at its limit in the next period.
        gain = backend.servo_gain
        lead = backend.control_period + (0.0 if gain is None else 1.0 / gain)
        self._reach = backend.joint_velocity * lead

    def to(self, goal: Floats) -> Floats:
        """The actions (N, J) of the next step to the configurations (N, J), rad (m)."""
        q, actions = self._simulation.backend.state.q, self._simulation.actions
        way = goal - q
        target = q + way / np.maximum(_most(way, self._reach), 1.0)
        if not isinstance(actions, RelativeActions):
            return target
        step, scale = target - actions.origin, actions.steps * actions.pace
        step = step / np.maximum(_most(step, scale), 1.0)
        return np.divide(step, scale, out=np.zeros_like(step), where=scale > 0.0)


def _most(values: Floats, of: Floats) -> Floats:
    """The largest ratio of an arm's values (N, J) to those of its joints that are not zero, (J,) or (N, J), as a column."""
    ratio = np.divide(np.abs(values), of, out=np.zeros_like(values), where=of > 0.0)
    return ratio.max(axis=1, keepdims=True)
