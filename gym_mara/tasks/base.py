"""The contract of a task: it judges the state of N arms against their goals, and knows nothing of engines."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from gym_mara import rotations
from gym_mara.collision.free_poses import FreePoses
from gym_mara.errors import GymMaraError, unknown
from gym_mara.robot import RobotModel
from gym_mara.state import SimState

Floats = NDArray[np.float64]

ON_COLLISION = ("reset", "terminate", "continue")


@dataclass(frozen=True, eq=False)
class Goal:
    """The poses to reach, in the world frame."""

    position: Floats
    """(N, 3), m."""
    quaternion: Floats
    """(N, 4), [w, x, y, z]."""

    @cached_property
    def _inverse(self) -> Floats:
        # Contiguous: the last bits of a dot product hang on the layout, and a copy's would be another.
        return np.ascontiguousarray(rotations.right_matrix(rotations.conjugate(self.quaternion)))

    def orientation_error(self, quaternion: Floats) -> Floats:
        """q ⊗ conj(goal) (N, 4), w >= 0, of end-effector orientations q (N, 4)."""
        return rotations.canonical(np.vecdot(self._inverse, quaternion[..., None, :]))


@dataclass(frozen=True)
class Task(ABC):
    """What the arms are to do. A subclass is a frozen dataclass of plain values, each an option of the environment.

    Observation and reward are written for N arms at once; the first axis of every array is N.

    Raises:
        GymMaraError: a value is of the wrong form or out of its range.
    """

    random_goal: ClassVar[bool] = False
    """Whether each episode has a goal of its own, from `draw_goal`."""

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
    def goal(self, robot: RobotModel, num_envs: int) -> Goal:
        """The goal of each arm."""

    def draw_goal(self, poses: FreePoses, generator: np.random.Generator) -> tuple[Floats, Floats]:
        """A goal for one episode: position (3,), m, and quaternion (4,) [w, x, y, z]; asked for where `random_goal` is set.

        Args:
            poses: draws poses within the arm's reach.
            generator: the episode's source of randomness.
        """
        raise NotImplementedError

    @abstractmethod
    def observation_space(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Box:
        """The space of one observation, for joints no faster than joint_velocity (J,), rad/s."""

    @abstractmethod
    def observe(self, state: SimState, goal: Goal) -> Floats:
        """The observations (N, O), a fresh array."""

    @abstractmethod
    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        """The rewards (N,) and the terms they are made of, each (N,), which `info` reports.

        Three names have a meaning elsewhere: of `distance` (m) the episode's statistics are kept, and `position_error`
        (m) and `angle_error` (rad) are what an evaluation prints.
        """

    def terminated(self, state: SimState, goal: Goal) -> NDArray[np.bool_]:
        """Which arms' episodes the task ends (N,); collisions are the environment's business."""
        return np.zeros(len(state.q), dtype=np.bool_)
