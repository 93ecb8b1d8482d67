"""The contract of a backend: it moves N arms, a control period at a time, and reports their state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from gym_mara.errors import positive_number
from gym_mara.robot import RobotModel
from gym_mara.state import SimState

Floats = NDArray[np.float64]


class Backend(ABC):
    """N independent arms of one robot in one engine.

    A subclass adds its engine's settings as keyword arguments of plain types. Inputs come checked: q and q_target are
    finite, of shape (N, J) and within the joint limits. What `state` returns is never changed afterwards.
    A backend pickles and deep-copies with its state.
    """

    in_processes: ClassVar[bool] = False
    """Whether many arms go faster spread over processes: for an engine that holds Python's lock while it steps."""
    teleports: bool = False
    """Whether the joints are at their targets at once."""
    random: bool = False
    """Whether episodes differ; if so `begin_episodes` is called before each."""
    diverged: NDArray[np.bool_] | None = None
    """The arms (N,) that the engine lost in the last step, if any: their state is the one before, their episode over."""

    def __init__(self, robot: RobotModel, num_envs: int, *, control_period: float = 0.02) -> None:
        self.robot = robot
        self.num_envs = num_envs
        self.control_period = positive_number("control_period", control_period, "s")
        self.joint_velocity = robot.velocity_limit
        """How fast the joints are at most in this backend (J,), rad/s."""

    @abstractmethod
    def reset(self, q: Floats, mask: NDArray[np.bool_] | None = None) -> None:
        """Put the arms, or those that the mask (N,) names, at rest at q (N, J), rad, with their time at zero."""

    @abstractmethod
    def step(self, q_target: Floats) -> SimState:
        """Move all arms towards q_target (N, J), rad, for one control period, and return their state then."""

    @property
    @abstractmethod
    def state(self) -> SimState:
        """The state now; right after a reset `collided` tells whether links touch at q."""

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: NDArray[np.bool_]) -> None:  # noqa: B027
        """Draw what is random about the episodes of the arms that the mask (N,) names, from a seed for each (N,)."""

    @property
    def sensor_noise(self) -> Floats | None:
        """The standard deviation of each arm's measured joint positions (N,), rad, if there is any."""
        return None

    def report(self) -> dict[str, NDArray[Any]]:
        """What `info` says of the arms beyond their state, each (N, …)."""
        return {}

    @abstractmethod
    def save(self) -> dict[str, Any]:
        """A snapshot of the simulation, from which it goes on identically; it pickles.

        Where `in_processes` is true every value is an array or a list with a row for each arm: then a snapshot fits
        whatever number of processes the arms are spread over.
        """

    @abstractmethod
    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot of a backend of the same robot, size and settings."""

    def close(self) -> None:  # noqa: B027 - most have nothing to free
        """Free the engine; nothing else is called afterwards."""
