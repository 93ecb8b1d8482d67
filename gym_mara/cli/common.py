"""What the commands share: the console, options, and the parsing of their values."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Annotated, Any

import typer
from rich.console import Console

from gym_mara.agents.algorithms.registry import ALGORITHMS, preset_names
from gym_mara.errors import GymMaraError, unknown
from gym_mara.extras import needs
from gym_mara.tasks import TASKS, task_names

out = Console()

EnvOption = Annotated[str, typer.Option("--env", help="Environment: " + ", ".join(TASKS) + ".")]
AlgoOption = Annotated[str, typer.Option(help="Algorithm: " + ", ".join(ALGORITHMS) + ".")]
PolicyOption = Annotated[
    str,
    typer.Option(
        help="last, or best: the policy with the highest reward in the evaluations of the training."
    ),
]
PresetOption = Annotated[
    str, typer.Option(help="Hyperparameters: " + " or ".join(preset_names()) + ".")
]
BackendOption = Annotated[str, typer.Option(help="Backend; gym-mara list shows all.")]
SetOption = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Keyword argument of the environment, as JSON, such as --set max_joint_velocity=1.57 "
        "or --set robot=ur5. May be repeated.",
    ),
]


def needs_agents() -> AbstractContextManager[None]:
    """Raise an error that names the extra if a library for training is missing."""
    return needs("training and evaluation", "train")


@contextmanager
def interruptible(message: str) -> Iterator[None]:
    """Print a message and exit if the user interrupts."""
    try:
        yield
    except KeyboardInterrupt:
        out.print(message, soft_wrap=True)
        raise typer.Exit(130) from None


def task_name(env: str) -> str:
    """The name of a task, given with or without the namespace of its id."""
    name = env.removeprefix("gym_mara:").removeprefix("gym_mara/")
    if name not in TASKS and name not in (names := task_names()):
        raise unknown("environment", env, names)
    return name


def whole(option: str, value: float) -> int:
    """The value of an option that must be a whole number of at least 1, which may be written as 1e6."""
    if not (value >= 1 and value == value // 1):
        raise GymMaraError(f"{option} must be a whole number of at least 1, not {value:g}")
    return int(value)


# Keyword arguments of the environments that the commands set themselves.
_OPTIONS = {
    "backend": "give --backend",
    "task": "give --env",
    "num_envs": "the preset sets the number of arms",
    "max_episode_steps": "the commands play episodes of their own length",
    "autoreset_mode": "the commands set it",
    "render_mode": "see gym-mara watch",
}


def keyword_arguments(settings: list[str]) -> dict[str, Any]:
    """Keyword arguments from NAME=VALUE; a value that is not JSON is taken as a string."""
    options = {}
    for setting in settings:
        name, separator, value = setting.partition("=")
        if name in _OPTIONS:
            raise GymMaraError(f"--set {setting!r}: {name} is no such keyword; {_OPTIONS[name]}")
        if not separator or not name.isidentifier():
            raise GymMaraError(f"--set {setting!r}: write NAME=VALUE")
        try:
            options[name] = json.loads(value)
        except ValueError as error:
            if value.lstrip().startswith(("{", "[", '"')):
                raise GymMaraError(f"--set {setting}: the value is not JSON: {error}") from None
            options[name] = value
    return options
