"""The named tasks. Each is registered as the environment `gym_mara/NAME`."""

from __future__ import annotations

from gym_mara.errors import unknown
from gym_mara.tasks.base import Task, Workspace
from gym_mara.tasks.goal import Goal
from gym_mara.tasks.observation import Observation, Part
from gym_mara.tasks.random_reach import RandomReachTask
from gym_mara.tasks.reach import ReachTask

__all__ = [
    "MAX_EPISODE_STEPS",
    "PAPER_TASKS",
    "TASKS",
    "Goal",
    "Observation",
    "Part",
    "ReachTask",
    "Task",
    "Workspace",
    "named_task",
]

TASKS: dict[str, Task] = {
    "MARA-v0": ReachTask(),
    "MARAOrient-v0": ReachTask(orientation=True),
    "MARACollision-v0": ReachTask(collision_penalty=True),
    "MARACollisionOrient-v0": ReachTask(orientation=True, collision_penalty=True),
    "MARARandomTarget-v0": RandomReachTask(),
}
PAPER_TASKS = tuple(TASKS)[:4]
"""The four environments of ROS2Learn."""
MAX_EPISODE_STEPS = 2048
"""The episode length of the registered environments, steps."""


def named_task(task: str | Task) -> Task:
    """Return the task with this name, or the task itself.

    Raises:
        GymMaraError: the name is unknown.
    """
    if isinstance(task, Task):
        return task
    if not isinstance(task, str) or task not in TASKS:
        raise unknown("task", task, TASKS)
    return TASKS[task]
