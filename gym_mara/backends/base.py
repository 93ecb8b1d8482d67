"""The contract of a backend: it moves N arms, one control period at a time, and reports their state."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gym_mara.errors import LARGEST, SMALLEST, GymMaraError, positive_number
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.types import Array, Floats, Mask

_NOT_STATED = 1.0
"""The velocity of a joint that teleports and whose limit is 0 or missing, rad/s (m/s)."""


class Backend(ABC):
    """N independent arms of one robot in one engine.

    A subclass adds its engine's settings as keyword-only arguments of plain types. Inputs are already checked: q and
    q_target are finite, of shape (N, J) and within the joint limits. What the simulation has to report is a field of
    `SimState`; besides it an environment reads only the attributes below. A backend pickles and deep-copies with its
    state.
    """

    in_processes: ClassVar[bool] = False
    """Whether many arms run faster in several processes: true for an engine that holds Python's lock while it steps."""
    dynamic: bool = False
    """Whether masses and forces count, so that the robot's must be right."""
    most_arms: ClassVar[int] = 2**20
    """The largest number of arms: with more, an ordinary machine runs out of memory."""
    precision: ClassVar[type[np.floating[Any]]] = np.float64
    """The floating-point type in which the engine computes; NumPy's arrays are in double precision all the same."""
    teleports: bool = False
    """Whether the joints reach their targets within a step, whatever the distance."""
    random: bool = False
    """Whether parameters are drawn for each episode; if so `begin_episodes` is called before its reset."""
    overshoot: float = 0.0
    """How far joints may be beyond their limits, rad (m): with dynamics, end stops give way a little."""
    first_arm: int = 0
    """The number of the first arm, for messages: not zero in a worker process, whose backend has a block of the arms."""
    joint_velocity: Floats
    """The highest velocity of each joint in this backend (J,), rad/s (m/s for a prismatic joint)."""
    control_period: float
    """How long one step lasts, s."""
    servo_gain: float | None = None
    """The gain of position servos, q̇ = clip(gain (target - q), ±joint_velocity), 1/s; None where joints reach targets that are
    within joint_velocity times control_period."""
    arrays: str = "numpy"
    """The library of the arrays that `reset` and `step` take, and of those in the states: "numpy", or "torch" for tensors.

    With tensors `contacts` is None. The other methods and attributes keep NumPy's arrays, snapshots too."""
    device: str | None = None
    """The device of the tensors in the names of torch, such as "cuda:0"; None with NumPy's arrays."""

    def __init__(self, robot: RobotModel, num_envs: int, *, control_period: float = 0.02) -> None:
        if self.dynamic:
            robot.require_dynamics()
        self.robot = robot
        self.num_envs = num_envs
        self.control_period = positive_number(
            "control_period",
            control_period,
            "s",
            at_least=1e-6,
            at_most=1e3,
            reason="no arm is controlled at others",
        )
        self.joint_velocity = robot.velocity_limit

    @classmethod  # noqa: B027 - most need nothing special
    def require_machine(cls) -> None:
        """Check that this machine has what the engine needs unless its settings say otherwise, such as a GPU.

        Raises:
            GymMaraError: it has not.
        """

    def asarray(self, values: ArrayLike) -> Array:
        """Values of the host as an array for this backend: flags stay flags, numbers become its floats.

        A backend of tensors overrides this method.
        """
        array = np.asarray(values)
        return array if array.dtype == np.bool_ else array.astype(np.float64, copy=False)

    @abstractmethod
    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        """Put all arms, or those of the mask (N,), at rest at their rows of q (N, J), rad (m for a prismatic joint), at time zero."""

    @abstractmethod
    def step(self, q_target: Floats) -> SimState:
        """Move all arms towards q_target (N, J), rad (m for a prismatic joint), for one control period, and return the state after it."""

    @property
    @abstractmethod
    def state(self) -> SimState:
        """The current state. Its arrays are fresh: writing to them changes neither the backend nor another state.

        Right after a reset `collided` says whether links touch at q.
        """

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: Mask) -> None:  # noqa: B027
        """Draw the parameters of new episodes for the arms of the mask (N,), each from its own seed (N,)."""

    @abstractmethod
    def save(self) -> dict[str, Any]:
        """A snapshot that pickles, and from which the simulation continues identically.

        A training can store it if it consists of plain values, arrays, random generators (PCG64), and lists, tuples and
        dicts of them.

        Where `in_processes` is true every value is an array, a list or a tuple with a row for each arm, or a dict of
        such values. Then a snapshot fits any number of processes.
        """

    @abstractmethod
    def restore(self, snapshot: dict[str, Any]) -> None:
        """Return to a snapshot of a backend of the same robot, size and settings.

        Raises:
            GymMaraError: it is of another backend. Nothing has changed then (`gym_mara.snapshots.check_fits`).
        """

    def close(self) -> None:  # noqa: B027 - most have nothing to free
        """Free the engine; no other method is called afterwards."""


def limited_velocity(robot: RobotModel, max_joint_velocity: float | None) -> Floats:
    """The highest velocity of each joint (J,), rad/s (m/s): the robot's limit, or `max_joint_velocity` where that is lower.

    Raises:
        GymMaraError: it is no positive number, or the robot's limit of a joint is zero.
    """
    limit = LARGEST
    if max_joint_velocity is not None:
        limit = positive_number("max_joint_velocity", max_joint_velocity, "rad/s")
    if (robot.velocity_limit < SMALLEST).any():
        joint = robot.joint_names[int(robot.velocity_limit.argmin())]
        raise GymMaraError(
            f"joint {joint} of {robot.name} cannot move at a limited velocity, because its velocity limit is 0: correct the "
            f"URDF, or give velocity_limit={{{joint!r}: …}}, rad/s (m/s)"
        )
    return np.minimum(limit, robot.velocity_limit)


def stated_velocity(velocity: Floats) -> Floats:
    """Velocity limits (J,), rad/s (m/s), for joints that teleport: 1 in place of those that are 0 or missing.

    Nothing moves so fast there, but steps of joints and bounds of observations need a number.
    """
    stated = (velocity >= SMALLEST) & (velocity < LARGEST)
    return np.where(stated, velocity, _NOT_STATED)
