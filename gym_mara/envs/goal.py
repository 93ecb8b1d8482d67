"""Goal environments in the format of Gymnasium-Robotics, for algorithms such as hindsight replay."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Dict, Space
from numpy.typing import NDArray

from gym_mara import rotations
from gym_mara.arrays import Constants, contiguous, host, namespace
from gym_mara.envs.options import Options
from gym_mara.envs.sensors import noise_of
from gym_mara.envs.simulation import Simulation
from gym_mara.envs.single import MaraEnv
from gym_mara.envs.vector import MaraVectorEnv
from gym_mara.errors import GymMaraError, one_of, positive_number
from gym_mara.registration import environment
from gym_mara.rendering.settings import STATE
from gym_mara.state import SimState
from gym_mara.tasks import Goal, Observation, Part, ReachTask, Task, observation
from gym_mara.types import Floats, Mask

REWARD_TYPES = ("sparse", "dense")
_ONE, _NO_TURN = Constants(1.0), Constants([1.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True)
class GoalSettings:
    """When a goal is reached, and what that is worth; the keyword arguments of MaraGoalEnv.

    Raises:
        GymMaraError: a value is out of its range.
    """

    reward_type: str
    position_tolerance: float
    angle_tolerance: float

    def __post_init__(self) -> None:
        one_of("reward_type", self.reward_type, REWARD_TYPES)
        for name, unit in (("position_tolerance", "m"), ("angle_tolerance", "rad")):
            object.__setattr__(self, name, positive_number(name, getattr(self, name), unit))


class GoalSimulation(Simulation):
    """A simulation whose observations are dictionaries, and whose rewards can be computed again for other goals.

    Args:
        options: as in Simulation; the task is a ReachTask.
        num_envs: N.
        settings: the tolerances and the reward.

    Raises:
        GymMaraError: the task is not a reach task, or the observation has no goals.
    """

    def __init__(self, options: Options, num_envs: int, settings: GoalSettings) -> None:
        self._settings = settings
        super().__init__(options, num_envs)

    def _prepare(self, options: Options) -> None:
        if not isinstance(self.task, ReachTask):
            raise GymMaraError(f"a goal environment needs a reach task, not {self.task!r}")
        if options.pixels.observation not in (STATE, "state+pixels"):
            raise GymMaraError(
                f"a goal environment observes its goals, so observation must be 'state' or 'state+pixels', not "
                f"{options.pixels.observation!r}"
            )
        super()._prepare(options)
        self._reach = self.task
        achieved, desired = (
            [observation.tool_position(self.robot)],
            [observation.target_position(self.robot)],
        )
        if self._reach.orientation:
            achieved.append(observation.tool_quaternion())
            desired.append(observation.target_quaternion())
        groups: dict[str, list[Part]] = {
            "observation": [
                observation.joint_positions(self.robot),
                observation.tool_velocity(self.robot, self.backend.joint_velocity),
            ],
            "achieved_goal": achieved,
            "desired_goal": desired,
        }
        overshoot = self.backend.overshoot
        self.observation = Observation([p for parts in groups.values() for p in parts], overshoot)
        spaces: dict[str, Space[Any]] = {}
        self._columns: dict[str, slice] = {}
        start = 0
        for name, parts in groups.items():
            box = Observation(parts, overshoot).space
            spaces[name], self._columns[name] = box, slice(start, start + box.shape[0])
            start += box.shape[0]
        self.form_space = Dict(spaces)

    def form(self, flat: Floats) -> dict[str, Floats]:
        """The groups of flat observations (…, O) by name."""
        return {name: contiguous(flat[..., own]) for name, own in self._columns.items()}

    def _reward(
        self, state: SimState, observation: Floats
    ) -> tuple[Floats, dict[str, NDArray[Any]]]:
        if noise_of(state) is not None:
            observation = self._observe(state, None)  # the reward is of the true state
        _, terms = super()._reward(state, observation)
        achieved, desired = (
            observation[:, self._columns[name]] for name in ("achieved_goal", "desired_goal")
        )
        success = self._succeeds(achieved, desired)
        if self._settings.reward_type == "sparse":
            reward = self._sparse(success, achieved)
        else:
            reward = self._dense(achieved, desired, state.collided)
        return reward, terms | {"is_success": success}

    def _goal_settings(self) -> dict[str, Any]:
        return {"goal_environment": True, **vars(self._settings)}

    @property
    def reward_needs_info(self) -> bool:
        """Whether `compute_reward` reads the info of each step: only then does the reward depend on collisions."""
        return self._settings.reward_type == "dense" and self._reach.collision_penalty

    def compute_reward(self, achieved: Floats, desired: Floats, info: Any) -> Any:
        """The rewards of goals, as in MaraGoalEnv."""
        shape = _common_shape("goals", achieved.shape, desired.shape)
        if self._settings.reward_type == "sparse":
            return self._sparse(self._succeeds(achieved, desired), achieved)
        collided = np.zeros(shape[:-1], np.bool_)
        if self.reward_needs_info:
            collided = _collided(info, shape[:-1], "the collision penalty")
        xp = namespace(achieved)
        poses, goals = (
            xp.broadcast_to(goal, shape).reshape(-1, shape[-1]) for goal in (achieved, desired)
        )
        collided = xp.asarray(collided.reshape(-1), device=achieved.device)
        reward = self._dense(poses, goals, collided)
        return reward.reshape(shape[:-1])

    def compute_terminated(self, achieved: Floats, desired: Floats, info: Any) -> Any:
        """Whether steps terminate the episode, as in MaraGoalEnv."""
        if type(self.task).terminated is not Task.terminated:
            raise GymMaraError(
                f"compute_terminated knows goals, and {type(self.task).__name__} terminates episodes by their state: read "
                "what step returns"
            )
        shape = _common_shape("goals", achieved.shape, desired.shape)[:-1]
        terminated = np.zeros(shape, np.bool_)
        if self.task.on_collision == "terminate":
            terminated = _collided(info, shape, "on_collision='terminate'")
        if not shape:
            return bool(terminated)
        return namespace(achieved).asarray(terminated, device=achieved.device)

    def _sparse(self, success: Any, achieved: Floats) -> Any:
        """0 for the goals that are reached, -1 for the others, in the float type of the goals."""
        _, one = _ONE.like(achieved)
        return success * one - one

    def _dense(self, achieved: Floats, desired: Floats, collided: Mask) -> Floats:
        """The rewards (N,) of the task for goals (N, G)."""
        goal = Goal(*self._poses(desired))
        return self._reach.judge(*self._poses(achieved), collided, goal)[0]

    def _succeeds(self, achieved: Floats, desired: Floats) -> Any:
        """Which goals (…, G) are reached."""
        xp, error = namespace(achieved), achieved[..., :3] - desired[..., :3]
        away = xp.sqrt(xp.sum(error * error, axis=-1))
        near = away <= self._settings.position_tolerance
        if self._reach.orientation:
            angle = rotations.angle_between(achieved[..., 3:], desired[..., 3:])
            near &= angle <= self._settings.angle_tolerance
        return near

    def _poses(self, goal: Floats) -> tuple[Floats, Floats]:
        """The positions (N, 3) and the quaternions (N, 4) of goals (N, G)."""
        if self._reach.orientation:
            return goal[:, :3], goal[:, 3:]
        xp, no_turn = _NO_TURN.like(goal)
        return goal, xp.tile(no_turn, (len(goal), 1))


def _common_shape(what: str, *shapes: tuple[int, ...]) -> tuple[int, ...]:
    """The shape to which these broadcast.

    Raises:
        GymMaraError: they do not.
    """
    try:
        return np.broadcast_shapes(*(tuple(shape) for shape in shapes))
    except ValueError:
        raise GymMaraError(
            f"the {what} have the shapes {' and '.join(str(tuple(shape)) for shape in shapes)}: "
            "give as many of each, or one for all"
        ) from None


def _collided(info: Any, shape: tuple[int, ...], reader: str) -> Mask:
    """Which steps collided, for a batch of goals of a shape (…,), from one info, a vector environment's, or one for each goal.

    Raises:
        GymMaraError: `collided` is missing, or they are not as many as the goals.
    """
    one_for_all = isinstance(info, Mapping)
    infos = [info] if one_for_all else np.array(info, dtype=object).reshape(-1)
    if not all("collided" in one for one in infos):
        raise GymMaraError(
            f"{reader} needs the info of each step, with 'collided': create HerReplayBuffer with copy_info_dict=True"
        )
    if one_for_all:
        collided = host(info["collided"])
    else:
        collided = np.array([one["collided"] for one in infos], np.bool_)
        if collided.size == math.prod(shape):
            collided = collided.reshape(shape)
    if _common_shape("goals and the infos", shape, collided.shape) != shape:
        raise GymMaraError(f"{collided.size} infos are more than the goals, of shape {shape}")
    return np.array(np.broadcast_to(collided, shape))  # torch takes no array that is read-only


class _GoalEnv:
    """The methods of a goal environment in Gymnasium-Robotics."""

    simulation: Any

    def compute_reward(self, achieved_goal: Floats, desired_goal: Floats, info: Any) -> Any:
        """Compute the rewards (...,) of achieved goals (..., G) for desired goals (..., G); one can stand for all of the others.

        Args:
            achieved_goal: the poses of the end effector; those of observations are measured if the sensors are noisy, and then
                these rewards are not those of `step`.
            desired_goal: the target poses.
            info: the info of one step of this environment, or a sequence with one info per goal. The collision penalty reads
                `collided`.

        Raises:
            GymMaraError: the shapes do not fit; or the task has a collision penalty, and an info has no `collided`.
        """
        return self.simulation.compute_reward(achieved_goal, desired_goal, info)

    def compute_terminated(self, achieved_goal: Floats, desired_goal: Floats, info: Any) -> Any:
        """Whether steps terminate the episode: not by reaching the goal, but by a collision with `on_collision="terminate"`.

        Args:
            achieved_goal, desired_goal, info: as in `compute_reward`. With "terminate" the infos need `collided`.

        Returns:
            A bool, or an array of flags (...,) for batches of goals.

        Raises:
            GymMaraError: the shapes do not fit, an info has no `collided`, or the task terminates episodes itself.
        """
        return self.simulation.compute_terminated(achieved_goal, desired_goal, info)

    def compute_truncated(self, achieved_goal: Floats, desired_goal: Floats, info: Any) -> bool:
        """False: a goal truncates no episode. What `step` truncates because its state diverged is not known here."""
        return False


class MaraGoalEnv(_GoalEnv, MaraEnv):
    """One arm; the reward of a step can be computed again for another goal.

    The observation is a dictionary. `observation` holds the joint positions (J,), rad, and the velocity of the end
    effector (3,), m/s. `achieved_goal` and `desired_goal` hold the positions (3,), m, of the end effector and of the
    target. If the task has `orientation`, their quaternions (4,), [w, x, y, z], follow. `info` also has `is_success`.
    With noisy sensors `achieved_goal` is measured, while rewards and `is_success` of `step` are of the true pose.

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
        self._goals = GoalSettings(reward_type, position_tolerance, angle_tolerance)
        super().__init__(task, **options)

    def _make_simulation(self, options: Options) -> Simulation:
        return GoalSimulation(options, 1, self._goals)


class MaraGoalVectorEnv(_GoalEnv, MaraVectorEnv):
    """N arms with goals in one batch: it gives the same results as N MaraGoalEnvs.

    Args:
        num_envs: N.
        task, reward_type, position_tolerance, angle_tolerance: as in MaraGoalEnv.
        **options: as in MaraVectorEnv; the default of `max_episode_steps` is that of MARAGoal-v0, 50.

    Raises:
        GymMaraError: a name is unknown, a value is out of its range, or the task is not a reach task.
    """

    def __init__(
        self,
        num_envs: int = 1,
        task: str | Task = "MARARandomTarget-v0",
        *,
        reward_type: str = "sparse",
        position_tolerance: float = 0.02,
        angle_tolerance: float = 0.1,
        **options: Any,
    ) -> None:
        self.closed = True  # until MaraVectorEnv has checked its arguments
        self._goals = GoalSettings(reward_type, position_tolerance, angle_tolerance)
        super().__init__(num_envs, task, **options)

    def _make_simulation(self, options: Options, num_envs: int) -> Simulation:
        return GoalSimulation(options, num_envs, self._goals)

    def _episode_steps(self, task: str | Task) -> int:
        return environment("MARAGoal-v0").max_episode_steps
