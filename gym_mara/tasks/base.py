"""The contract of a task: it observes and rewards the states of N arms with their goals, whatever the backend."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol

import numpy as np

from gym_mara.arrays import zeros_like
from gym_mara.errors import finite_numbers, one_of, positive_number
from gym_mara.state import SimState
from gym_mara.tasks.goal import Goal
from gym_mara.tasks.observation import Part
from gym_mara.types import Floats, Mask

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel

ON_COLLISION = ("reset", "terminate", "continue")
MAX_EPISODE_STEPS = 2048
"""The length of the paper's episodes, steps."""


class Draw(NamedTuple):
    """What is drawn for one episode."""

    start: Floats | None
    """The start configuration (J,), rad; None for the task's usual one."""
    position: Floats
    """Of the goal (3,), m."""
    quaternion: Floats
    """Of the goal (4,), [w, x, y, z]."""


class Workspace(Protocol):
    """The poses that the end effector can reach. A pose is a position (3,), m, and a quaternion (4,), [w, x, y, z]."""

    home: Floats
    """The robot's home configuration (J,), rad."""

    def draw(self, generator: np.random.Generator) -> tuple[Floats, Floats]:
        """The pose of a random collision-free configuration."""

    def draw_move(self, generator: np.random.Generator, start: Floats | None = None) -> Draw:
        """A random collision-free start, unless one is given, and the pose of another configuration.

        No collision is on the straight joint move from the one to the other.
        """

    def configurations(self, position: Floats, quaternion: Floats | None, start: Floats) -> Floats:
        """Collision-free configurations (N, K, J), rad (m), at N poses; infinite where fewer are found.

        On the straight way from the start (N, J) to the nearest one there is no collision, if that can be had.
        """

    def default_pose(self) -> tuple[Floats, Floats]:
        """The pose of a collision-free configuration, always the same for a robot."""

    def shortfall(self, position: Floats | None, quaternion: Floats | None) -> tuple[float, float]:
        """How close the arm can come to a pose: the remaining distance, m, and the remaining angle, rad.

        None stands for any position, or any orientation.
        """


@dataclass(frozen=True)
class Task(ABC):
    """The goal, the observation and the reward of an environment.

    A subclass is a frozen dataclass of plain values. Each value is a keyword argument of the environments. Observation
    and reward are computed for N arms at once: the first axis of every array is N.

    Raises:
        GymMaraError: a value has the wrong form or is out of its range.
    """

    random_goal: ClassVar[bool] = False
    """Whether `draw_goal` draws a new goal for each episode."""
    preset_family: ClassVar[str] = ""
    """The family of tasks for which an algorithm may have presets of its own; see docs/add_an_algorithm.md."""

    default_action: ClassVar[str] = "absolute"
    """The action mode of the environments unless the keyword argument `action` chooses one."""

    observes_action: ClassVar[bool] = False
    """Whether the last action is a part of the observation, the last one."""
    episode_steps: ClassVar[int] = MAX_EPISODE_STEPS
    """The length of episodes, unless a registered environment has its own, steps."""

    on_collision: str = "reset"
    """The effect of a collision: "reset" (the arm returns to the start pose and the episode continues), "terminate" or
    "continue"."""
    start_q: tuple[float, ...] | None = None
    """The start configuration (J,), rad (m for a prismatic joint); None for the robot's home configuration."""

    def __post_init__(self) -> None:
        one_of("on_collision", self.on_collision, ON_COLLISION)
        self._make_plain("start_q", None)

    def _make_plain(self, name: str, length: int | None) -> None:
        """Convert a vector option to a tuple of floats, so that tasks can be compared, printed and stored as JSON."""
        values = getattr(self, name)
        if values is None:
            return
        object.__setattr__(self, name, tuple(finite_numbers(name, values, length)))

    def _check_ranges(
        self, ranges: Mapping[str, tuple[float, float, str, bool]], reason: str
    ) -> None:
        """Make values floats, and check them.

        Args:
            ranges: the smallest and the largest positive value of each, its unit, and whether it can be zero, by name.
            reason: why others are refused.

        Raises:
            GymMaraError: a value is out of its range.
        """
        for name, (low, high, unit, or_zero) in ranges.items():
            value = positive_number(
                name,
                getattr(self, name),
                unit,
                or_zero=or_zero,
                at_least=low,
                at_most=high,
                reason=reason,
            )
            object.__setattr__(self, name, value)

    @abstractmethod
    def goal(self, robot: RobotModel, workspace: Workspace, num_envs: int) -> Goal:
        """The goals of N arms before the first episode; they stay if `random_goal` is false."""

    def draw_goal(
        self, workspace: Workspace, generator: np.random.Generator
    ) -> tuple[Floats, Floats]:
        """Draw the goal of one episode: position (3,), m, and quaternion (4,), [w, x, y, z].

        Environments call this method only if `random_goal` is true.

        Args:
            workspace: the poses that the arm can reach.
            generator: the random generator of the arm's goals.
        """
        raise NotImplementedError

    def draw(self, workspace: Workspace, generator: np.random.Generator) -> Draw:
        """Draw the start and the goal of one episode; by default the goal of `draw_goal`, and no start.

        Environments call this method only if `random_goal` is true.
        """
        return Draw(None, *self.draw_goal(workspace, generator))

    def configurations(
        self, workspace: Workspace, position: Floats, quaternion: Floats, start: Floats
    ) -> Floats | None:
        """The configurations (N, K, J) at goals that the observation or the reward needs; None by default.

        Args:
            workspace: the poses that the arm can reach.
            position: of the goals (N, 3), m.
            quaternion: of the goals (N, 4), [w, x, y, z].
            start: where the arms are (N, J), rad (m).
        """
        return None

    @abstractmethod
    def observation(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Sequence[Part]:
        """The parts of the observation, in order.

        Args:
            robot: the arm.
            goal: the initial goals; they change with `random_goal`.
            joint_velocity: the largest speed of each joint (J,), rad/s.
        """

    @abstractmethod
    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        """The rewards (N,), and their terms by name, each (N,), which `info` reports.

        Three names have a special meaning: the episode statistics use `distance` (m), and an evaluation prints
        `position_error` (m) and `angle_error` (rad).
        """

    def terminated(self, state: SimState, goal: Goal) -> Mask:
        """The arms (N,) whose episodes the task terminates. The environment handles collisions."""
        return zeros_like(state.collided)
