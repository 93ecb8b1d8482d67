"""Checks of the arrays that are given as actions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.arrays import is_tensor
from gym_mara.errors import GymMaraError
from gym_mara.types import Array, UnitActions


def action_array(action: Any, meaning: str, *, units: bool) -> NDArray[Any]:
    """Return an action as an array of integers or floats.

    Args:
        action: the action.
        meaning: what its numbers are, for messages.
        units: whether it may hold the `UnitActions` of a policy.

    Raises:
        GymMaraError: it has another type, is masked, or holds UnitActions that are not allowed.
    """
    if type(action) is np.ndarray:
        array = action
    else:
        if is_tensor(action) and action.device.type != "cpu":
            raise GymMaraError(
                f"the action is a tensor on {action.device}, and this environment takes NumPy's arrays: give "
                "action.cpu().numpy(), or choose a backend that has arrays='torch'"
            )
        for value in (action, *action) if isinstance(action, Sequence) else (action,):
            if isinstance(value, UnitActions) and not units:
                raise GymMaraError(
                    "these actions are in [-1, 1], as the policy was trained; wrap the environment in "
                    "gymnasium.wrappers.RescaleAction(env, -1, 1), or play the policy with "
                    "gym_mara.agents.runs.load_policy; a policy of relative or cartesian actions needs an environment with the "
                    "same action=…"
                )
            if isinstance(value, np.ma.MaskedArray):
                raise GymMaraError(
                    "an action cannot be a masked array, because every number is needed; give an array without a mask"
                )
        try:
            array = np.asarray(action)
        except (TypeError, ValueError, RuntimeError) as error:
            raise GymMaraError(f"an action must be an array of numbers: {error}") from error
    if array.dtype.kind not in "fiu":
        raise GymMaraError(
            f"an action must be an array of integers or floats ({meaning}), not of {array.dtype}"
        )
    return array


def action_tensor(action: Any, meaning: str, like: Array) -> Array:
    """Return an action, which must be a tensor of floats on the device of another tensor, in the float type of that one.

    `meaning` says what its numbers are, for messages.

    Raises:
        GymMaraError: it is an array of another library, on another device, or not of floats.
    """
    if not is_tensor(action):
        raise GymMaraError(
            f"this environment takes tensors of torch on {like.device}, not a value of type {type(action).__name__}: "
            f"give torch.as_tensor(actions, device={str(like.device)!r}), or choose arrays='numpy'"
        )
    if action.device != like.device:
        raise GymMaraError(
            f"the action is a tensor on {action.device}, and this environment is on {like.device}: give "
            f"actions.to({str(like.device)!r})"
        )
    if not action.is_floating_point():
        raise GymMaraError(
            f"an action must be a tensor of floats ({meaning}), not of {action.dtype}: give actions.float()"
        )
    return action.detach().to(like.dtype)
