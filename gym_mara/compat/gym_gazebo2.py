"""For scripts written for gym-gazebo2: importing this module registers its bare ids, `MARA-v0`, … .

docs/from_gym_gazebo2.md maps its flags and scripts.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from gymnasium.envs.registration import register
from numpy.typing import NDArray

from gym_mara.envs import MaraEnv
from gym_mara.errors import GymMaraError, positive_number, whole_number
from gym_mara.robot import RobotModel
from gym_mara.robot.kinematics import Kinematics
from gym_mara.state import SimState
from gym_mara.tasks import MAX_EPISODE_STEPS, PAPER_TASKS, Goal, Observation, Part
from gym_mara.types import Floats

RUN_VELOCITY = 0.5
"""How fast the joints are in gym-gazebo2's run mode by default, rad/s."""
# Flags of gym-gazebo2 that say something of Gazebo and ROS alone.
_NO_MEANING = {
    "multi_instance": "environments share nothing: make as many as you like",
    "port": "there is no simulator to connect to",
}


class GazeboMaraEnv(MaraEnv):
    """MaraEnv with the manners of gym-gazebo2.

    The episode ends by itself, after 2048 steps or what `set_episode_size` says, and its last `info` has gym-gazebo2's
    statistics under `infos`.

    Args:
        task: the name of a task.
        gui: open the viewer in the browser; -g of gym-gazebo2's scripts.
        real_speed: joints that travel, and are not at their targets at once; -r.
        velocity: how fast they travel, rad/s; -v.
        original_observation: whether the velocity in the observation is what gym-gazebo2 has there, J(q)·q, the Jacobian
            times the joint positions, by a slip; else the true J(q)·q̇.
        **options: as of MaraEnv.

    Raises:
        GymMaraError: as of MaraEnv; or an option says something of Gazebo alone.
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
        for flag, instead in _NO_MEANING.items():
            if flag in options:
                raise GymMaraError(f"{flag!r} has no meaning here: {instead}; leave it out")
        if velocity is not None and not real_speed:
            raise GymMaraError("'velocity' is that of joints that travel: give real_speed=True too")
        if real_speed:
            speed = RUN_VELOCITY if velocity is None else velocity
            options["max_joint_velocity"] = positive_number("velocity", speed, "rad/s")
        if gui:
            options["render_mode"] = "human"
        super().__init__(task, **options)
        self._episode_size = MAX_EPISODE_STEPS
        if original_observation:
            slip = _position_for_velocity(self.simulation.robot)
            parts = self.simulation.observation.parts
            self.simulation.observation = Observation(
                [slip if part.name == slip.name else part for part in parts]
            )
            self.observation_space = self.simulation.observation.space  # type: ignore[assignment]

    def set_episode_size(self, episode_size: int) -> None:
        """End episodes after so many steps, from this one on."""
        self._episode_size = whole_number("episode_size", episode_size)

    def step(self, action: NDArray[np.float32]) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Move towards the joint targets (J,), rad, for one control period.

        Raises:
            GymMaraError: the action has the wrong shape or is not finite; the arm has not moved then.
        """
        observation, reward, terminated, truncated, info = super().step(action)
        statistics = info["statistics"]
        truncated = truncated or statistics["ep_steps"] >= self._episode_size
        if terminated or truncated:
            info["infos"] = {name: v for name, v in statistics.items() if name != "ep_steps"}
        return observation, reward, terminated, truncated, info


def _position_for_velocity(robot: RobotModel) -> Part:
    """gym-gazebo2's part in place of the end effector's velocity: J(q)·q, the Jacobian times the joint positions."""
    # No part of the arm is farther along than each joint's reach times its angle.
    farthest = float((robot.reach * np.maximum(-robot.lower, robot.upper)).sum())
    bound = np.full(3, farthest)
    return Part(
        "tool_velocity", -bound, bound, partial(_jacobian_times_position, robot.kinematics())
    )


def _jacobian_times_position(kinematics: Kinematics, state: SimState, goal: Goal) -> Floats:
    return kinematics.velocity(state.q, state.q)


for _name in PAPER_TASKS:
    register(
        id=_name,
        entry_point="gym_mara.compat.gym_gazebo2:GazeboMaraEnv",
        kwargs={"task": _name},
    )
