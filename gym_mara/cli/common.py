"""What the commands share: the consoles, options, and the parsing of their values."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console

from gym_mara.agents.algorithms.registry import ALGORITHMS, preset_names
from gym_mara.backends import backend_names
from gym_mara.cli import INTERRUPTED
from gym_mara.errors import GymMaraError, unknown
from gym_mara.extras import needs
from gym_mara.registration import ENVIRONMENTS, environment_name
from gym_mara.rendering import RenderSettings

_LARGEST_INTEGER = 2**63


class _Console(Console):
    def on_broken_pipe(self) -> None:
        raise


# Without markup: brackets in paths and names are text.
out, err = _Console(markup=False), _Console(markup=False, stderr=True)


def whole(lowest: int, highest: int) -> Callable[[str], int]:
    """A parser of whole numbers in a range; 1e6 and 1_000_000 are whole numbers, too."""

    def parse(text: str) -> int:
        number = _number(text)
        if not (lowest <= number <= highest and number == int(number)):
            example = ", such as 300000 or 3e5" if highest > 300_000 else ""
            raise typer.BadParameter(
                f"must be a whole number from {lowest:,} to {highest:,}{example}, not {text[:80]!r}"
            )
        return int(number)

    return parse


def number(lowest: float, highest: float) -> Callable[[str], float]:
    """A parser of numbers in a range."""

    def parse(text: str) -> float:
        value = _number(text)
        if not lowest <= value <= highest:
            raise typer.BadParameter(
                f"must be a number from {lowest:g} to {highest:g}, not {text[:80]!r}"
            )
        return value

    return parse


def _number(text: str) -> float:
    try:
        return float(text)
    except (ValueError, OverflowError):
        return math.nan


def one_of(kind: str, names: Callable[[], Iterable[str]]) -> Callable[[str], str]:
    """A parser of a name; the error suggests the most similar one."""

    def parse(text: str) -> str:
        valid = list(names())
        if text not in valid:
            raise typer.BadParameter(str(unknown(kind, text, valid)))
        return text

    return parse


def env_name(env: str) -> str:
    """The name of an environment, given with or without the namespace of its id."""
    try:
        return environment_name(env)
    except GymMaraError as error:
        raise typer.BadParameter(str(error)) from None


def several(parse: Callable[[str], str]) -> Callable[[str], str]:
    """A parser of names that are separated by commas; the option may be repeated, too."""
    return lambda text: ",".join(parse(name.strip()) for name in text.split(","))


def names_in(option: str, values: Iterable[str]) -> tuple[str, ...]:
    """The names in the values of an option with `several` names.

    Raises:
        GymMaraError: a name is given twice.
    """
    names = tuple(name for value in values for name in value.split(","))
    if len(set(names)) < len(names):
        raise GymMaraError(f"{option} {','.join(names)}: give each name once")
    return names


algorithm_name = one_of("algorithm", lambda: ALGORITHMS)
backend_name = one_of("backend", backend_names)

COUNT = whole(1, 10**12)
EnvOption = Annotated[
    str,
    typer.Option(
        "--env",
        parser=env_name,
        metavar="NAME",
        help="Environment: " + ", ".join(ENVIRONMENTS) + ", or one of another package.",
    ),
]
AlgoOption = Annotated[
    str,
    typer.Option(
        "--algo",
        parser=algorithm_name,
        metavar="NAME",
        help="Algorithm: " + ", ".join(ALGORITHMS) + ".",
    ),
]
PresetOption = Annotated[
    str,
    typer.Option(
        parser=one_of("preset", preset_names),
        metavar="NAME",
        help="Hyperparameters: " + " or ".join(preset_names()) + ".",
    ),
]
OwnBackendOption = Annotated[
    str | None,
    typer.Option(
        parser=backend_name,
        metavar="NAME",
        help="Backend; by default that of the environment. gym-mara list shows all.",
    ),
]
RunBackendOption = Annotated[
    str | None,
    typer.Option(
        parser=backend_name, metavar="NAME", help="Backend to play on; by default that of the run."
    ),
]
StepsOption = Annotated[
    int,
    typer.Option(
        parser=COUNT,
        metavar="N",
        help="Environment steps of a run, over all its arms, such as 1e6.",
    ),
]
CheckpointOption = Annotated[
    int,
    typer.Option(
        parser=COUNT, metavar="N", help="Steps between two checkpoints; each is evaluated."
    ),
]
SeedsOption = Annotated[
    int,
    typer.Option(parser=whole(1, 1000), metavar="N", help="How many runs, each with its own seed."),
]
SetOption = Annotated[
    list[str],
    typer.Option(
        "--set",
        metavar="NAME=VALUE",
        help="Keyword argument of the environment, beside those of the run, as JSON: "
        "--set max_joint_velocity=1.57 --set robot=ur5.",
    ),
]


def needs_agents() -> AbstractContextManager[None]:
    """Raise an error that names the extra if a library for training is missing."""
    return needs("training and evaluation", "train")


@contextmanager
def interruptible(message: str | Callable[[], str]) -> Iterator[None]:
    """Print a message and exit if the user interrupts."""
    try:
        yield
    except KeyboardInterrupt:
        text = message if isinstance(message, str) else message()
        err.print(text, soft_wrap=True, highlight=False)
        raise typer.Exit(INTERRUPTED) from None


def is_given(context: typer.Context, name: str) -> bool:
    """Whether a parameter of the command was given on the command line."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def refuse(context: typer.Context, reason: str, *names: str) -> None:
    """Refuse options that would have no effect.

    Args:
        context: of the command.
        reason: why they have none; the message begins with it.
        names: the parameters of the options; all of the command's if none is given.

    Raises:
        GymMaraError: one of them was given on the command line.
    """
    given = [
        parameter.opts[0]
        for parameter in context.command.params
        if (parameter.name in names or not names) and is_given(context, parameter.name or "")
    ]
    if given:
        raise GymMaraError(f"{reason}: leave out {', '.join(given)}")


# Keyword arguments of the environments that the commands set themselves.
_SET_BY_COMMANDS = {
    "backend": "give --backend",
    "task": "give --env",
    "num_envs": "the preset sets the number of arms",
    "max_episode_steps": "the commands play episodes of their own length",
    "autoreset_mode": "the commands set it",
    "render_mode": "see gym-mara watch",
}
_OF_PICTURES = frozenset(field.name for field in dataclasses.fields(RenderSettings))
_OF_VIEWER = frozenset(name for name in _OF_PICTURES if name.startswith("viewer_"))


def keyword_arguments(
    settings: list[str], *, pictures: bool = False, viewer: bool = False
) -> dict[str, Any]:
    """Keyword arguments from NAME=VALUE; a value that is not JSON, nor True, False or None, is taken as a string.

    Args:
        settings: what `--set` was given.
        pictures: whether the command draws pictures.
        viewer: whether the command opens the viewer.

    Raises:
        GymMaraError: a setting has another form, is given twice, or has no effect in this command.
    """
    options: dict[str, Any] = {}
    for setting in settings:
        name, separator, value = setting.partition("=")
        if name in _SET_BY_COMMANDS:
            raise GymMaraError(
                f"--set {setting!r}: {name} is no such keyword; {_SET_BY_COMMANDS[name]}"
            )
        if not separator or not name.isidentifier() or name == "self":
            raise GymMaraError(
                f"--set {setting!r}: write NAME=VALUE, such as max_joint_velocity=1.57"
            )
        if name in options:
            raise GymMaraError(f"--set {name} is given twice: give it once")
        if name in _OF_VIEWER and not viewer:
            raise GymMaraError(f"--set {name} has no effect here: no viewer opens; leave it out")
        if name in _OF_PICTURES - _OF_VIEWER and not pictures:
            raise GymMaraError(
                f"--set {name} has no effect here: no picture is drawn; leave it out"
            )
        options[name] = _value(setting, value)
    return options


_PYTHON = {"True": True, "False": False, "None": None}
"""Values that a user of Python writes where JSON has true, false and null."""


def _value(setting: str, text: str) -> Any:
    if text in _PYTHON:
        return _PYTHON[text]
    try:
        return json.loads(
            text, parse_constant=_refuse_number, parse_int=_integer, parse_float=_finite
        )
    except RecursionError:
        raise GymMaraError(f"--set {setting[:40]}…: the value is nested too deeply") from None
    except GymMaraError as error:
        raise GymMaraError(f"--set {setting[:80]}: {error}") from None
    except ValueError as error:
        if text.lstrip().startswith(("{", "[", '"')):
            raise GymMaraError(f"--set {setting}: the value is not JSON: {error}") from None
        return text


def _refuse_number(text: str) -> NoReturn:
    raise GymMaraError(f"{text[:20]} is not a finite number of at most 2**63")


def _integer(text: str) -> int:
    if len(text) > 20 or abs(int(text)) > _LARGEST_INTEGER:
        _refuse_number(text)
    return int(text)


def _finite(text: str) -> float:
    value = float(text)
    return value if math.isfinite(value) else _refuse_number(text)
