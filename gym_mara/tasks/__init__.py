"""The tasks by name; each is registered as the environment `gym_mara/NAME`."""

from __future__ import annotations

import dataclasses
from typing import Any

from gym_mara.errors import unknown
from gym_mara.tasks.base import Goal, Task
from gym_mara.tasks.random_reach import RandomReachTask
from gym_mara.tasks.reach import ReachTask

__all__ = ["PAPER_TASKS", "TASKS", "Goal", "ReachTask", "Task", "make_task"]

TASKS: dict[str, Task] = {
    "MARA-v0": ReachTask(),
    "MARAOrient-v0": ReachTask(orientation=True),
    "MARACollision-v0": ReachTask(collision_penalty=True),
    "MARACollisionOrient-v0": ReachTask(orientation=True, collision_penalty=True),
    "MARARandomTarget-v0": RandomReachTask(),
}
PAPER_TASKS = tuple(TASKS)[:4]
"""The four environments of ROS2Learn."""


def make_task(task: str | Task, options: dict[str, Any]) -> tuple[Task, dict[str, Any]]:
    """A task of this name with some of its values replaced, and the options that are not its own.

    Raises:
        GymMaraError: the name is unknown, or a value is out of its range.
    """
    if isinstance(task, str):
        if task not in TASKS:
            raise unknown("task", task, TASKS)
        task = TASKS[task]
    names = {field.name for field in dataclasses.fields(task)}
    own = {name: value for name, value in options.items() if name in names}
    rest = {name: value for name, value in options.items() if name not in names}
    return dataclasses.replace(task, **own), rest
