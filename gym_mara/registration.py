"""The environments by name: the tasks, and the goal environment. Each is registered with Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from gymnasium.envs.registration import register

from gym_mara.errors import GymMaraError, unknown, whole_number
from gym_mara.tasks.base import MAX_EPISODE_STEPS, Task
from gym_mara.tasks.registry import PAPER_TASKS, TASKS, named_task, task_names

_NAMESPACE = "gym_mara"


class Environment(NamedTuple):
    """How an environment is made."""

    task: str
    """The name of its task."""
    max_episode_steps: int
    """The length of its episodes, steps."""
    goals: bool = False
    """Whether it is a goal environment: its classes are MaraGoalEnv and MaraGoalVectorEnv, else MaraEnv and MaraVectorEnv."""
    keywords: Mapping[str, Any] = {}
    """Its own keyword arguments, which a user may replace."""


ENVIRONMENTS: dict[str, Environment] = {}
"""The environments that are registered with Gymnasium in this process, by name."""


def register_task(
    name: str, task: Task | None = None, *, max_episode_steps: int | None = None
) -> None:
    """Register a task as an environment of Gymnasium, single and vectorised.

    A task may be registered again after its class was defined again, as by a notebook's cell: it takes the place of the first
    one. Gymnasium warns of that.

    Args:
        name: the name of the task and the id of the environment, such as "my_package/MARATouch-v0".
        task: the task; None for the task of an entry point `gym_mara.tasks` with this name.
        max_episode_steps: the number of steps after which an episode is truncated; by default that of the task, or of the
            paper's environments for the task of an entry point.

    Raises:
        GymMaraError: `task` is no Task, or another task has this name.
    """
    if task is not None and not isinstance(task, Task):
        raise GymMaraError(f"task must be a Task, such as TouchTask(), not {task!r}")
    name = name.removeprefix(f"{_NAMESPACE}/")
    if task is not None:
        if not _same(TASKS.get(name, task), task):
            raise GymMaraError(f"another task has the name {name!r}: choose another name")
        TASKS[name] = task
    steps = MAX_EPISODE_STEPS if task is None else task.episode_steps
    if max_episode_steps is not None:
        steps = whole_number("max_episode_steps", max_episode_steps)
    _register(name, Environment(name, steps), {"task": name})


def _same(one: Task, other: Task) -> bool:
    """Whether two tasks are equal, or their classes are two definitions of the same one."""
    old, new = type(one), type(other)
    named = (old.__module__, old.__qualname__) == (new.__module__, new.__qualname__)
    return one == other or (old is not new and named)


def _register(name: str, environment: Environment, keywords: dict[str, str]) -> None:
    kind = "Goal" if environment.goals else ""
    register(
        id=environment_id(name),
        entry_point=f"gym_mara.envs:Mara{kind}Env",
        vector_entry_point=f"gym_mara.envs:Mara{kind}VectorEnv",
        kwargs=keywords,
        max_episode_steps=environment.max_episode_steps,
    )
    ENVIRONMENTS[name] = environment


def register_environments() -> None:
    """Register the environments of this package."""
    for name, task in list(TASKS.items()):
        register_task(name, task)
    _register("MARAGoal-v0", Environment("MARARandomTarget-v0", 50, goals=True), {})
    for name, keywords in (
        ("MARAReal-v0", {"backend": "ros2"}),
        ("MARACamera-v0", {"observation": "state+pixels"}),
    ):
        own = Environment("MARA-v0", MAX_EPISODE_STEPS, keywords=keywords)
        _register(name, own, {"task": "MARA-v0", **keywords})


def environment_id(name: str) -> str:
    """The id with Gymnasium: a name without a namespace is of this package."""
    return name if "/" in name else f"{_NAMESPACE}/{name}"


def file_name(name: str) -> str:
    """The name of an environment for files and folders: a namespace is separated by a hyphen."""
    return name.replace("/", "-")


def environment_names() -> list[str]:
    """The names that `environment` knows. No other package is imported."""
    return [*ENVIRONMENTS, *(name for name in task_names() if name not in ENVIRONMENTS)]


def environment(name: str) -> Environment:
    """The environment with this name, which may have the form of an id: "gym_mara/MARA-v0", "gym_mara:gym_mara/MARA-v0".

    Raises:
        GymMaraError: the name is unknown, or the task of another package cannot be loaded.
    """
    own = environment_name(name)
    if own not in ENVIRONMENTS:
        task = named_task(own)  # imports the other package, which may register it
        return ENVIRONMENTS.get(own) or Environment(own, task.episode_steps)
    return ENVIRONMENTS[own]


def is_of_paper(name: str) -> bool:
    """Whether the environment with this name has one of the paper's four tasks, whose highest reward is 10 per step.

    Raises:
        GymMaraError: the name is unknown, or the task of another package cannot be loaded.
    """
    return environment(name).task in PAPER_TASKS


def own_backend(name: str) -> str:
    """The backend of the environment with this name, unless a user gives another.

    Raises:
        GymMaraError: the name is unknown, or the task of another package cannot be loaded.
    """
    from gym_mara.backends import DEFAULT_BACKEND  # `import gym_mara` imports no backend

    return str(environment(name).keywords.get("backend", DEFAULT_BACKEND))


def environment_name(name: str) -> str:
    """The name of an environment, given with or without the module and the namespace of its id.

    Raises:
        GymMaraError: the name is unknown.
    """
    own = str(name).rpartition(":")[2].removeprefix(f"{_NAMESPACE}/")
    if own not in ENVIRONMENTS and own not in (names := environment_names()):
        raise unknown("environment", name, names)
    return own
