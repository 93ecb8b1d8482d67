"""The tasks: each defines the goal, the observation and the reward of an environment."""

from __future__ import annotations

from gym_mara.tasks.any_target import AnyTargetTask
from gym_mara.tasks.base import MAX_EPISODE_STEPS, Draw, Task, Workspace
from gym_mara.tasks.goal import Goal
from gym_mara.tasks.observation import Observation, Part
from gym_mara.tasks.reach import ReachTask
from gym_mara.tasks.registry import (
    PAPER_TASKS,
    TASKS,
    named_task,
    task_names,
)

__all__ = [
    "MAX_EPISODE_STEPS",
    "PAPER_TASKS",
    "TASKS",
    "AnyTargetTask",
    "Draw",
    "Goal",
    "Observation",
    "Part",
    "ReachTask",
    "Task",
    "Workspace",
    "named_task",
    "task_names",
]
