"""The interface of gym-gazebo2. Importing this module registers its ids without a namespace: `MARA-v0`, … .

docs/from_gym_gazebo2.md maps its flags and scripts to those of gym_mara.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from gymnasium.envs.registration import register
from numpy.typing import NDArray

from gym_mara.compat.moments import Moments
from gym_mara.compat.two_targets import TwoTargetsTask
from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError, flag, positive_number, whole_number
from gym_mara.robot import RobotModel
from gym_mara.robot.kinematics import Kinematics
from gym_mara.state import SimState
from gym_mara.tasks import PAPER_TASKS, Goal, Observation, Part, Task
from gym_mara.types import Floats

RUN_VELOCITY = 0.5
"""The default joint speed of gym-gazebo2's run mode, rad/s."""
EPISODE_SIZE = 1024
"""The default length of gym-gazebo2's episodes, steps."""
# Flags of gym-gazebo2 that only concern Gazebo and ROS, and the reason why gym_mara does not need them.
_NO_MEANING = {
    "multi_instance": "environments are independent, so make as many as you like",
    "port": "there is no simulator to connect to",
}
# The tasks that are not those of the same name in gym_mara.
_TASKS: dict[str, Task] = {"MARARandomTarget-v0": TwoTargetsTask()}


class GazeboMaraEnv(MaraEnv):
    """MaraEnv with the interface of gym-gazebo2.

    The environment itself truncates an episode, after 1024 steps or after the number of steps from `set_episode_size`.
    The last `info` of an episode contains gym-gazebo2's statistics under `infos`: largest, mean and smallest value, standard
    deviation and skewness of the distance (m) and of the reward, the number of collisions, and the position of the target (m).

    Args:
        task: the name of a task; "MARARandomTarget-v0" is gym-gazebo2's, with two targets.
        gui: show the arm in the browser; flag -g of gym-gazebo2's scripts.
        real_speed: joints move with a limited speed, and do not jump to their targets; flag -r.
        velocity: the joint speed with real_speed, rad/s; flag -v.
        original_observation: whether the observation has J(q)·q, the Jacobian times the joint positions, in place of
            the end effector's velocity J(q)·q̇. gym-gazebo2 has this error.
        **options: as in MaraEnv.

    Raises:
        GymMaraError: as in MaraEnv, or an option only concerns Gazebo.
    """

    def __init__(
        self,
        task: str = "MARA-v0",
        *,
        gui: bool = False,
        real_speed: bool = False,
        velocity: float | None = None,
        original_observation: bool = False,
        **options: Any,
    ) -> None:
        for name, reason in _NO_MEANING.items():
            if name in options:
                raise GymMaraError(f"{name!r} has no meaning here: {reason}; leave it out")
        gui, real_speed = flag("gui", gui), flag("real_speed", real_speed)
        original_observation = flag("original_observation", original_observation)
        if velocity is not None and not real_speed:
            raise GymMaraError(
                "'velocity' has no effect without real_speed: give real_speed=True too"
            )
        if real_speed and options.get("max_joint_velocity") is not None:
            raise GymMaraError(
                "real_speed and max_joint_velocity both limit the joint speed: give velocity with real_speed, or "
                "max_joint_velocity alone"
            )
        if gui and options.get("render_mode") not in (None, "human"):
            raise GymMaraError(
                f"gui shows the arm in the browser, which is render_mode='human', not {options['render_mode']!r}: leave out one"
            )
        if original_observation and options.get("observation") in ("pixels", "joints+pixels"):
            raise GymMaraError(
                "original_observation concerns the state: give observation='state' or 'state+pixels', not "
                f"{options['observation']!r}"
            )
        if real_speed:
            speed = RUN_VELOCITY if velocity is None else velocity
            options["max_joint_velocity"] = positive_number("velocity", speed, "rad/s")
        if gui:
            options["render_mode"] = "human"
        super().__init__(_TASKS.get(task, task) if isinstance(task, str) else task, **options)
        self._episode_size = EPISODE_SIZE
        self._moments = Moments()
        if original_observation:
            replacement = _position_for_velocity(self.simulation.robot)
            parts = self.simulation.observation.parts
            self.simulation.observation = Observation(
                [replacement if part.name == replacement.name else part for part in parts],
                self.simulation.backend.overshoot,
            )
            self.simulation.form_space = self.simulation.observation.space
            self.observation_space = self.simulation.observation_space

    def set_episode_size(self, episode_size: int) -> None:
        """Set the length of the current and all later episodes, steps."""
        self._episode_size = whole_number("episode_size", episode_size)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode, as in MaraEnv."""
        result = super().reset(seed=seed, options=options)
        self._moments = Moments()
        return result

    def step(self, action: NDArray[np.float32]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Execute an action (A,) for one control period.

        Raises:
            GymMaraError: the action has the wrong type or shape, or is not finite. The arm does not move then.
        """
        observation, reward, terminated, truncated, info = super().step(action)
        statistics = info["statistics"]
        self._moments.add(info["distance"], reward)
        truncated = truncated or statistics["ep_steps"] >= self._episode_size
        if terminated or truncated:
            info["infos"] = self._infos(statistics)
        return observation, reward, terminated, truncated, info

    def _infos(self, statistics: dict[str, float]) -> dict[str, float]:
        """gym-gazebo2's statistics of the episode that ends."""
        target = dict(zip("xyz", self.simulation.goal.position[0].tolist(), strict=True))
        return {
            **{name: value for name, value in statistics.items() if name != "ep_steps"},
            **self._moments.summary(),
            **{f"target_{axis}": value for axis, value in target.items()},
        }

    def save_state(self) -> dict[str, Any]:
        """A snapshot as in MaraEnv, with the length of the episodes and their statistics."""
        return super().save_state() | {
            "episode_size": self._episode_size,
            "moments": self._moments.values.copy(),
        }

    def restore_state(self, snapshot: dict[str, Any]) -> None:
        """Restore a snapshot of an environment with the same arguments.

        Raises:
            GymMaraError: it is of another environment. Nothing has changed then.
        """
        super().restore_state(snapshot)
        self._episode_size = snapshot["episode_size"]
        self._moments.values[...] = snapshot["moments"]

    def _snapshot_form(self) -> dict[str, Any]:
        return super()._snapshot_form() | {"episode_size": int, "moments": self._moments.values}


def _position_for_velocity(robot: RobotModel) -> Part:
    """gym-gazebo2's replacement of the end effector's velocity: J(q)·q, the Jacobian times the joint positions."""
    # |J(q)·q| is at most the sum over the joints of reach times largest angle.
    farthest = float((robot.reach * np.maximum(-robot.lower, robot.upper)).sum())
    bound = np.full(3, farthest)
    return Part(
        "tool_velocity", -bound, bound, partial(_jacobian_times_position, robot.kinematics())
    )


def _jacobian_times_position(kinematics: Kinematics, state: SimState, goal: Goal) -> Floats:
    return kinematics.velocity(state.q, state.q)


_ENVIRONMENTS: dict[str, dict[str, str]] = {
    **{name: {"task": name} for name in (*PAPER_TASKS, *_TASKS)},
    "MARAReal-v0": {"task": "MARA-v0", "backend": "ros2", "profile": "mara-2019"},
}
for _name, _keywords in _ENVIRONMENTS.items():
    register(
        id=_name,
        entry_point="gym_mara.compat.gym_gazebo2:GazeboMaraEnv",
        kwargs=_keywords,
        order_enforce=False,  # Gymnasium's wrappers would hide `set_episode_size`
        disable_env_checker=True,
    )
