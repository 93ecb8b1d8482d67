"""The actions of an arm: joint targets."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import action_range
from gym_mara.types import UnitActions


def action_space(robot: RobotModel) -> Box[np.float32]:
    """The space of an arm's actions (J,): joint targets, in the range of `action_range`."""
    low, high = action_range(robot)
    return Box(low.astype(np.float32), high.astype(np.float32), dtype=np.float32)


def joint_targets(action: ArrayLike) -> NDArray[Any]:
    """Return an action as an array of integers or floats.

    Raises:
        GymMaraError: it has another type, is masked, or holds the `UnitActions` of a policy.
    """
    if type(action) is np.ndarray:
        array = action
    else:
        for value in (action, *action) if isinstance(action, Sequence) else (action,):
            if isinstance(value, UnitActions):
                raise GymMaraError(
                    "these actions are in [-1, 1], as the policy was trained; wrap the environment in "
                    "gymnasium.wrappers.RescaleAction(env, -1, 1), or play the policy with "
                    "gym_mara.agents.runs.load_policy"
                )
            if isinstance(value, np.ma.MaskedArray):
                raise GymMaraError(
                    "an action cannot be a masked array, because each joint needs a target; give an array without a mask"
                )
        try:
            array = np.asarray(action)
        except (TypeError, ValueError, RuntimeError) as error:
            raise GymMaraError(f"an action must be an array of numbers: {error}") from error
    if array.dtype.kind not in "fiu":
        raise GymMaraError(
            f"an action must be an array of integers or floats (joint targets, rad), not of {array.dtype}"
        )
    return array
