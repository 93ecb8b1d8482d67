"""The contract of a task: it judges the state of N arms against their goals, and knows no engine."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np

from gym_mara import rotations
from gym_mara.errors import GymMaraError, unknown
from gym_mara.state import SimState
from gym_mara.tasks.observation import Part
from gym_mara.types import Floats, Mask

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel

ON_COLLISION = ("reset", "terminate", "continue")


class Workspace(Protocol):
    """Which poses the end effector can have. A pose is a position (3,), m, and a quaternion (4,), [w, x, y, z]."""

    def draw(self, generator: np.random.Generator) -> tuple[Floats, Floats]:
        """The pose of a random configuration without a collision."""

    def default_pose(self) -> tuple[Floats, Floats]:
        """The pose of a configuration without a collision, always the same for a robot."""

    def shortfall(self, position: Floats, quaternion: Floats | None) -> tuple[float, float]:
        """How near the arm can come to a pose: the distance left, m, and the angle left, rad."""


@dataclass(frozen=True, eq=False)
class Goal:
    """The poses to reach, in the world frame."""

    position: Floats
    """(N, 3), m."""
    quaternion: Floats
    """(N, 4), [w, x, y, z]."""

    @cached_property
    def _inverse(self) -> Floats:
        # Contiguous: the last bits of a dot product depend on the memory layout, which a copy would change.
        return np.ascontiguousarray(rotations.right_matrix(rotations.conjugate(self.quaternion)))

    def orientation_error(self, quaternion: Floats) -> Floats:
        """q ⊗ conj(goal) (N, 4), w >= 0, of end-effector orientations q (N, 4)."""
        return rotations.canonical(np.vecdot(self._inverse, quaternion[..., None, :]))


@dataclass(frozen=True)
class Task(ABC):
    """What the arms are to do. A subclass is a frozen dataclass of plain values; each is a keyword argument.

    Observation and reward are written for N arms at once: the first axis of every array is N.

    Raises:
        GymMaraError: a value is of the wrong form or out of its range.
    """

    random_goal: ClassVar[bool] = False
    """Whether each episode has its own goal, from `draw_goal`."""

    on_collision: str = "reset"
    """What follows a collision: "reset" (back to the start pose, the episode goes on), "terminate" or "continue"."""
    start_q: tuple[float, ...] | None = None
    """The start pose (J,), rad; None for the robot's home."""

    def __post_init__(self) -> None:
        if self.on_collision not in ON_COLLISION:
            raise unknown("on_collision", self.on_collision, ON_COLLISION)
        self._make_plain("start_q", None)

    def _make_plain(self, name: str, length: int | None) -> None:
        """Turn a vector option into a tuple of floats, so that tasks compare, print and go through JSON."""
        values = getattr(self, name)
        if values is None:
            return
        try:
            array = np.asarray(values, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise GymMaraError(f"{name} must be a list of numbers, not {values!r}") from error
        if array.ndim != 1 or (length and len(array) != length) or not np.isfinite(array).all():
            wanted = f"{length} " if length else ""
            raise GymMaraError(f"{name} must be a list of {wanted}finite numbers, not {values!r}")
        object.__setattr__(self, name, tuple(array.tolist()))

    @abstractmethod
    def goal(self, robot: RobotModel, workspace: Workspace, num_envs: int) -> Goal:
        """The goal of each arm."""

    def draw_goal(
        self, workspace: Workspace, generator: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """The goal of one episode: position (3,), m, and quaternion (4,), [w, x, y, z]; called if `random_goal` is true.

        Args:
            workspace: which poses the arm can reach.
            generator: the arm's source of random goals.
        """
        raise NotImplementedError

    @abstractmethod
    def observation(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Sequence[Part]:
        """The parts of an observation, in their order.

        Args:
            robot: the arm.
            goal: the goals at first; with `random_goal` they change.
            joint_velocity: how fast the joints can be (J,), rad/s.
        """

    @abstractmethod
    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        """The rewards (N,), and the terms that they are made of, each (N,), which `info` reports.

        Three names have a meaning elsewhere: the episode's statistics are those of `distance` (m), and an evaluation
        prints `position_error` (m) and `angle_error` (rad).
        """

    def terminated(self, state: SimState, goal: Goal) -> Mask:
        """Which arms' episodes the task ends (N,); what follows a collision is for the environment."""
        return np.zeros(len(state.q), dtype=np.bool_)
