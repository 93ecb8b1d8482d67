"""The environments: one arm or a batch of arms, and the same with goals for hindsight replay."""

from __future__ import annotations

import dataclasses
from typing import Any

from gym_mara.envs.goal import GoalSettings, MaraGoalEnv, MaraGoalVectorEnv
from gym_mara.envs.single import MaraEnv
from gym_mara.envs.vector import MaraVectorEnv
from gym_mara.registration import environment
from gym_mara.tasks import named_task

__all__ = [
    "MaraEnv",
    "MaraGoalEnv",
    "MaraGoalVectorEnv",
    "MaraVectorEnv",
    "make_vector_env",
    "task_keywords",
]


def task_keywords(name: str) -> set[str]:
    """The names of the keyword arguments that the task and the goals of an environment have.

    Raises:
        GymMaraError: the name of the environment is unknown.
    """
    made = environment(name)
    forms: list[Any] = [named_task(made.task), *([GoalSettings] if made.goals else [])]
    return {field.name for form in forms for field in dataclasses.fields(form)}


def make_vector_env(name: str, num_envs: int, **options: Any) -> MaraVectorEnv:
    """Make the vector environment of a name, as `gymnasium.make_vec` does for its id.

    Args:
        name: the name of an environment, such as "MARA-v0", "MARAGoal-v0" or "my_package/MARATouch-v0".
        num_envs: N.
        **options: as in MaraVectorEnv or MaraGoalVectorEnv.

    Raises:
        GymMaraError: a name is unknown, or a value is out of its range.
    """
    made = environment(name)
    kind = MaraGoalVectorEnv if made.goals else MaraVectorEnv
    own = {"task": made.task, "max_episode_steps": made.max_episode_steps, **made.keywords}
    return kind(num_envs, **(own | options))
