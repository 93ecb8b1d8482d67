"""MaraGoalEnv: a goal environment in the format of Gymnasium-Robotics, for algorithms such as hindsight replay."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.spaces import Dict, Space
from numpy.typing import NDArray

from gym_mara import rotations
from gym_mara.envs.single import MaraEnv
from gym_mara.errors import GymMaraError, positive_number, unknown
from gym_mara.tasks import Goal, Observation, Part, ReachTask, Task, observation
from gym_mara.types import Floats

REWARD_TYPES = ("sparse", "dense")


class MaraGoalEnv(MaraEnv):
    """One arm; the reward of a step can be computed again for another goal.

    The observation is a dictionary. `observation` holds the joint positions (J,), rad, and the velocity of the end
    effector (3,), m/s. `achieved_goal` and `desired_goal` hold the positions (3,), m, of the end effector and of the
    target. If the task has `orientation`, their quaternions (4,), [w, x, y, z], follow. `info` also has `is_success`.

    Args:
        task: the name of a reach task, or a ReachTask.
        reward_type: "sparse" for 0 within the tolerances and -1 elsewhere, or "dense" for the task's reward.
        position_tolerance: the largest distance to the target that is a success, m.
        angle_tolerance: the largest angle to the target that is a success, rad; used if the task has `orientation`.
        **options: as in MaraEnv.

    Raises:
        GymMaraError: a name is unknown, a value is out of its range, or the task is not a reach task.
    """

    def __init__(
        self,
        task: str | Task = "MARARandomTarget-v0",
        *,
        reward_type: str = "sparse",
        position_tolerance: float = 0.02,
        angle_tolerance: float = 0.1,
        **options: Any,
    ) -> None:
        if reward_type not in REWARD_TYPES:
            raise unknown("reward_type", reward_type, REWARD_TYPES)
        self.reward_type = reward_type
        self.position_tolerance = positive_number("position_tolerance", position_tolerance, "m")
        self.angle_tolerance = positive_number("angle_tolerance", angle_tolerance, "rad")
        super().__init__(task, **options)
        if not isinstance(self.simulation.task, ReachTask):
            raise GymMaraError(f"a goal environment needs a reach task, not {task!r}")
        self.task = self.simulation.task
        robot, backend = self.simulation.robot, self.simulation.backend
        self._groups: dict[str, list[Part]] = {
            "observation": [
                observation.joint_positions(robot),
                observation.tool_velocity(robot, backend.joint_velocity),
            ],
            "achieved_goal": [observation.tool_position(robot)],
            "desired_goal": [observation.target_position(robot)],
        }
        if self.task.orientation:
            self._groups["achieved_goal"].append(observation.tool_quaternion())
            self._groups["desired_goal"].append(observation.target_quaternion())
        self.simulation.observation = Observation(
            [part for parts in self._groups.values() for part in parts]
        )
        spaces: dict[str, Space[Any]] = {
            name: Observation(parts).space for name, parts in self._groups.items()
        }
        self.observation_space = Dict(spaces)  # type: ignore[assignment]

    def reset(  # type: ignore[override]
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Floats], dict[str, Any]]:
        """Begin an episode at the start pose."""
        flat, info = super().reset(seed=seed, options=options)
        return self._as_goals(flat), info

    def step(  # type: ignore[override]
        self, action: NDArray[np.float32]
    ) -> tuple[dict[str, Floats], float, bool, bool, dict[str, Any]]:
        """Move towards joint targets (J,), rad, for one control period.

        Raises:
            GymMaraError: the action has the wrong type or shape, or is not finite. The arm does not move then.
        """
        flat, _, terminated, truncated, info = super().step(action)
        goals = self._as_goals(flat)
        achieved, desired = goals["achieved_goal"], goals["desired_goal"]
        info["is_success"] = bool(self._succeeds(achieved, desired))
        reward = float(self.compute_reward(achieved, desired, info))
        return goals, reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: Floats, desired_goal: Floats, info: Any) -> Any:
        """Compute the rewards (...,) of achieved goals (..., G) for desired goals (..., G).

        Args:
            achieved_goal: the poses of the end effector.
            desired_goal: the target poses.
            info: the info of one step, or a sequence with one info per goal. The collision penalty reads `collided`.

        Raises:
            GymMaraError: the task has a collision penalty, and an info has no `collided`.
        """
        if self.reward_type == "sparse":
            return self._succeeds(achieved_goal, desired_goal) - 1.0
        achieved, desired = np.atleast_2d(achieved_goal), np.atleast_2d(desired_goal)
        collided = np.zeros(len(achieved), np.bool_)
        if self.task.collision_penalty:
            infos = [info] if isinstance(info, Mapping) else list(info)
            if not all("collided" in one for one in infos):
                raise GymMaraError(
                    "the collision penalty needs the info of each step: create HerReplayBuffer with copy_info_dict=True"
                )
            collided = np.array([one["collided"] for one in infos])
        position, quaternion = self._parts(achieved)
        reward, _ = self.task.judge(position, quaternion, collided, Goal(*self._parts(desired)))
        return reward.reshape(np.shape(achieved_goal)[:-1])

    def compute_terminated(self, achieved_goal: Floats, desired_goal: Floats, info: Any) -> bool:
        """False: an episode continues after the goal is reached."""
        return False

    def compute_truncated(self, achieved_goal: Floats, desired_goal: Floats, info: Any) -> bool:
        """False: a goal truncates no episode."""
        return False

    def _succeeds(self, achieved: Floats, desired: Floats) -> Any:
        away = np.linalg.norm(achieved[..., :3] - desired[..., :3], axis=-1)
        near = away <= self.position_tolerance
        if self.task.orientation:
            angle = rotations.angle_between(achieved[..., 3:], desired[..., 3:])
            near &= angle <= self.angle_tolerance
        return near

    def _parts(self, goal: Floats) -> tuple[Floats, Floats]:
        """The positions (N, 3) and the quaternions (N, 4) of goals (N, G)."""
        if self.task.orientation:
            return goal[:, :3], goal[:, 3:]
        return goal, np.tile([1.0, 0.0, 0.0, 0.0], (len(goal), 1))

    def _as_goals(self, flat: Floats) -> dict[str, Floats]:
        """Convert the flat observation (O,) to the dictionary."""
        values = self.simulation.observation.split(flat)
        return {
            name: np.concatenate([values[part.name] for part in parts])
            for name, parts in self._groups.items()
        }
