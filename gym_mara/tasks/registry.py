"""The tasks by name: those below, and those that other packages offer as entry points `gym_mara.tasks`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from gym_mara.errors import GymMaraError, unknown
from gym_mara.tasks.any_target import AnyTargetTask
from gym_mara.tasks.base import Task
from gym_mara.tasks.random_reach import RandomReachTask
from gym_mara.tasks.reach import ReachTask

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

TASKS: dict[str, Task] = {
    "MARA-v0": ReachTask(),
    "MARAOrient-v0": ReachTask(orientation=True),
    "MARACollision-v0": ReachTask(collision_penalty=True),
    "MARACollisionOrient-v0": ReachTask(orientation=True, collision_penalty=True),
    "MARARandomTarget-v0": RandomReachTask(),
    "MARAReach-v0": AnyTargetTask(),
    "MARAPose-v0": AnyTargetTask(orientation=True, position_tolerance=0.005),
}
"""The tasks of this package, and those that `gym_mara.register_task` has added."""
PAPER_TASKS = tuple(TASKS)[:4]
"""The four environments of ROS2Learn."""
_GROUP = "gym_mara.tasks"


class BrokenTaskError(GymMaraError):
    """Another package offers a task that cannot be loaded."""


def task_names() -> list[str]:
    """The names that `named_task` knows. No other package is imported."""
    return [*TASKS, *sorted({entry.name for entry in _entry_points()} - TASKS.keys())]


def named_task(task: str | Task) -> Task:
    """Return the task with this name, or the task itself.

    Raises:
        GymMaraError: the name is unknown.
        BrokenTaskError: another package offers the task, and it cannot be loaded.
    """
    if isinstance(task, Task):
        return task
    if not isinstance(task, str):
        raise unknown("task", task, task_names())
    if task not in TASKS:
        found = [entry for entry in _entry_points() if entry.name == task]
        if not found:
            raise unknown("task", task, task_names())
        loaded = _load(found[0])
        TASKS.setdefault(task, loaded)
    return TASKS[task]


def _entry_points() -> list[EntryPoint]:
    """Only read for a name that is not in TASKS, and for a list: reading them takes some 30 ms."""
    from importlib.metadata import entry_points

    return list(entry_points(group=_GROUP))


def _load(entry_point: EntryPoint) -> Task:
    """The task of an entry point: a Task, a subclass, or a function that returns one."""
    try:
        task = entry_point.load()
        if not isinstance(task, Task) and callable(task):
            task = task()
    except Exception as error:
        raise _broken(entry_point, f"{type(error).__name__}: {error}") from error
    if not isinstance(task, Task):
        raise _broken(entry_point, "not a Task, a subclass of it, or a function that returns one")
    return task


def _broken(entry_point: EntryPoint, reason: str) -> BrokenTaskError:
    package = entry_point.dist.name if entry_point.dist else "another package"
    return BrokenTaskError(
        f"the task {entry_point.name!r} of {package} cannot be loaded from {entry_point.value!r} ({reason}); "
        "repair or uninstall that package"
    )
