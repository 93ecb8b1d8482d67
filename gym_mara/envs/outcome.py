"""The result of a step of a simulation."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.state import SimState
from gym_mara.types import Floats, Mask


class Outcome(NamedTuple):
    """The result of one step, per arm, in the backend's arrays."""

    observation: Floats
    """The observations (N, O); for an arm that collided, from its colliding configuration."""
    reward: Floats
    """The rewards (N,)."""
    terminated: Mask
    """Whether the episode terminated (N,)."""
    truncated: Mask | None
    """Whether the arm's state diverged (N,); None if no arm's did."""
    info: dict[str, NDArray[Any]]
    """The task's reward terms and `collided`, each (N,); torques, contacts, random parameters and timing, each (N, …),
    if the state has them."""
    state: SimState
    """The state that the task rewarded; for an arm that collided, its colliding configuration."""


def report(state: SimState) -> dict[str, NDArray[Any]]:
    """The torques, contacts, random parameters and timing of a state, for `info`, each (N, …)."""
    values: dict[str, NDArray[Any]] = {}
    if state.torque is not None:
        values["joint_torque"] = state.torque
    if state.contacts is not None:
        contacts = np.empty(len(state.contacts), dtype=object)
        for arm, found in enumerate(state.contacts):
            contacts[arm] = [contact._asdict() for contact in found]
        values["contacts"] = contacts
    if state.parameters is not None:
        values |= state.parameters
    if state.timing is not None:
        values |= state.timing
    return values
