"""Reach any target: a random position or pose in each episode, from a random start, without a collision on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from gym_mara import rotations
from gym_mara.arrays import Constants, zeros_like
from gym_mara.errors import flag, one_of
from gym_mara.state import SimState
from gym_mara.tasks import observation, rewards
from gym_mara.tasks.base import Draw, Task, Workspace
from gym_mara.tasks.goal import Goal
from gym_mara.tasks.observation import Part
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.robot import RobotModel

STARTS = ("random", "home")
_ONE = Constants(1.0)
# The smallest and the largest positive value of each number, its unit, and whether it can be zero.
_TOLERANCES = {
    "position_tolerance": (1e-6, 1.0, "m", False),
    "angle_tolerance": (1e-6, np.pi, "rad", False),
}
_WEIGHTS = {
    "length_per_angle": (1e-3, 10.0, "m/rad", False),
    "slow_within": (1e-6, 1.0, "m", False),
    "rate_weight": (1e-6, 1e3, "", True),
    "progress_weight": (1e-6, 1e3, "s/rad", True),
    "collision_weight": (1e-6, 1e6, "", True),
}


@dataclass(frozen=True)
class AnyTargetTask(Task):
    """Bring the end effector to a random target, drawn for each episode, and keep it there.

    The start and the target are collision-free configurations, and the straight joint move between them is free as well, so
    every target can be reached. Each value is a keyword argument of the environments.
    """

    random_goal: ClassVar[bool] = True
    default_action: ClassVar[str] = "relative"
    observes_action: ClassVar[bool] = True
    episode_steps: ClassVar[int] = 200
    preset_family: ClassVar[str] = "any_target"

    on_collision: str = "terminate"
    start_q: tuple[float, ...] | None = None
    """The start configuration (J,), rad (m for a prismatic joint); None for that of `start`."""
    orientation: bool = False
    """Whether the target has an orientation."""
    start: str = "random"
    """Where episodes begin: at a "random" collision-free configuration, or at "home"; `start_q` has precedence."""
    guide: bool = False
    """Whether the way to the nearest configuration for the target is observed and rewarded; inverse kinematics finds it."""
    position_tolerance: float = 0.002
    """The largest distance to the target that is a success, m."""
    angle_tolerance: float = float(np.radians(2.5))
    """The largest angle to the target that is a success, rad; used with `orientation`."""
    length_per_angle: float = 0.2
    """How much an angle counts beside a distance, m/rad."""
    slow_within: float = 0.05
    """The error of position and angle together from which steps shrink in proportion to it, m: near the target an action is a
    part of the way, so that the arm comes to rest there."""
    rate_weight: float = 0.05
    """How much the change of actions costs."""
    progress_weight: float = 3.0
    """With `guide`: how much it counts how fast the arm moves straight to the configuration, s/rad."""
    collision_weight: float = 100.0
    """How much a collision costs."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("orientation", "guide"):
            object.__setattr__(self, name, flag(name, getattr(self, name)))
        one_of("start", self.start, STARTS)
        self._check_ranges(_TOLERANCES, "others say nothing about a success")
        self._check_ranges(_WEIGHTS, "the reward is not accurate with others")

    def goal(self, robot: RobotModel, workspace: Workspace, num_envs: int) -> Goal:
        """The default pose of the workspace, until the first episode draws another."""
        position, quaternion = workspace.default_pose()
        return Goal(np.tile(position, (num_envs, 1)), np.tile(quaternion, (num_envs, 1)))

    def draw(self, workspace: Workspace, generator: np.random.Generator) -> Draw:
        fixed = self.start_q is not None or self.start == "home"
        start = self.start_q if self.start_q is not None else workspace.home
        return workspace.draw_move(generator, np.array(start) if fixed else None)

    def configurations(
        self, workspace: Workspace, position: Floats, quaternion: Floats, start: Floats
    ) -> Floats | None:
        if not self.guide:
            return None
        return workspace.configurations(position, quaternion if self.orientation else None, start)

    def observation(self, robot: RobotModel, goal: Goal, joint_velocity: Floats) -> Sequence[Part]:
        """Joint positions and velocities, the poses of the tool and the target, the guide, and the parts of `ArmParts`."""
        from gym_mara.tasks.arm_parts import ArmParts  # which takes long: it needs Pinocchio

        parts = [
            observation.joint_positions(robot),
            observation.joint_cosines_and_sines(robot),
            observation.joint_velocities(joint_velocity),
            observation.tool_position(robot),
            observation.target_position(robot),
        ]
        if self.orientation:
            parts += [observation.tool_rotation(), observation.target_rotation()]
        own = ArmParts(
            robot, joint_velocity, self.orientation, self.length_per_angle, self.slow_within
        )
        if self.guide:
            parts.append(observation.joint_ways_to_configuration(robot))
        return [*parts, *own.parts()]

    def reward(self, state: SimState, goal: Goal) -> tuple[Floats, dict[str, Floats]]:
        """How near the tool is to the target, less the costs of the action's change and of a collision; and the terms.

        The terms are `distance` and `position_error` (m), `angle_error` (rad), `reward_closeness`, `reward_rate`,
        `reward_collision`, with the guide `reward_progress`, and `success`.
        """
        error = state.ee_position - goal.position
        xp, _ = _ONE.like(error)
        distance = xp.sqrt(xp.vecdot(error, error))
        angle = rotations.angle_between(state.ee_quaternion, goal.quaternion)
        success = distance <= self.position_tolerance
        together = distance
        if self.orientation:
            together = distance + self.length_per_angle * angle
            success = success & (angle <= self.angle_tolerance)
        close = rewards.closeness(together)
        rate = zeros_like(close)
        if state.action is not None and state.last_action is not None:
            change = state.action - state.last_action
            rate = self.rate_weight * xp.mean(change * change, axis=-1)
        collision = self.collision_weight * xp.astype(state.collided, close.dtype)
        reward, more = close - rate - collision, {}
        if self.guide:
            progress = self.progress_weight * _approach(state, goal)
            reward, more = reward + progress, {"reward_progress": progress}
        return reward, {
            "distance": distance,
            "position_error": distance,
            "angle_error": angle,
            "reward_closeness": close,
            "reward_rate": -rate,
            "reward_collision": -collision,
            **more,
            "success": success & ~state.collided,
        }


def _approach(state: SimState, goal: Goal) -> Floats:
    """How fast the arm moves straight to the nearest configuration (N,), rad/s (m/s); 0 where none is known.

    The speed at which the joint with the longest way approaches it, less the largest deviation of a joint's velocity from that
    with which all joints would arrive together.
    """
    way = goal.ways(state.q)
    xp, one = _ONE.like(way)
    size = xp.abs(way)
    longest = xp.argmax(size, axis=-1)
    row = xp.arange(len(longest), device=longest.device)
    far = size[row, longest]
    ahead = way / xp.where(far > 0.0, far, one)[:, None]
    speed = state.qd[row, longest] * ahead[row, longest]
    deviation = xp.max(xp.abs(state.qd - speed[:, None] * ahead), axis=-1)
    return xp.where(far > 0.0, speed - deviation, zeros_like(speed))
