"""Assigns the keyword arguments of an environment to the task, the backend, the actions, the sensors and the pictures."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from gym_mara.backends import backend_names, backend_settings
from gym_mara.envs.actions import ActionSettings
from gym_mara.envs.given import GIVEN
from gym_mara.envs.sensors import SensorSettings
from gym_mara.errors import GymMaraError, one_of, unknown
from gym_mara.rendering import PixelSettings, RenderSettings
from gym_mara.robot import RobotLike, RobotModel, RobotOptions
from gym_mara.tasks import Task, named_task

_ALIKE = 0.85
"""How alike two names are, as a ratio, if the one is taken for the other misspelt; `randomisation` and `pixel_randomisation` are
0.81."""


@dataclass(frozen=True)
class Options:
    """The task, the robot, the backend and the settings of an environment."""

    task: Task
    robot: RobotModel
    backend: str
    """The name of the backend."""
    settings: dict[str, Any]
    """The backend's keyword arguments."""
    actions: ActionSettings
    sensors: SensorSettings
    rendering: RenderSettings
    pixels: PixelSettings

    @classmethod
    def sort(
        cls,
        task: str | Task,
        robot: RobotLike,
        ee_frame: str | None,
        backend: str,
        keywords: dict[str, Any],
        receiver: type[object] | None = None,
    ) -> Options:
        """Assign each keyword argument to the part of the environment that knows its name.

        Args:
            task: the name of a task, or a task.
            robot: a robot's name, the path of a URDF, a list of MARA's modules, or a RobotModel.
            ee_frame: the end-effector link of a URDF of your own.
            backend: the name of a backend.
            keywords: values of the task and the robot, and settings of the backend, the actions, the sensors, the rendering and
                the pictures of observations.
            receiver: the class of the environment that received them, for the names in an error.

        Raises:
            GymMaraError: a name is unknown or belongs to two parts, or a value is out of its range.
            MissingExtraError: a library is not installed.
        """
        chosen = named_task(task)
        rooms = {
            "task": _names(chosen),
            "robot": _names(RobotOptions),
            "backend": backend_settings(backend),
            "actions": _names(ActionSettings),
            "sensors": _names(SensorSettings),
            "rendering": _names(RenderSettings),
            "observation": _names(PixelSettings),
        }
        own: dict[str, dict[str, Any]] = {room: {} for room in rooms}
        for name, value in keywords.items():
            owners = [room for room, names in rooms.items() if name in names]
            if not owners:
                valid = {name for names in rooms.values() for name in names}
                if name in GIVEN and chosen.random_goal:
                    raise GymMaraError(
                        f"this environment draws its targets: give {name!r} to reset, in its options, not to its constructor"
                    )
                raise _unknown_keyword(name, valid | _own_names(receiver), backend)
            if len(owners) > 1:
                raise GymMaraError(
                    f"the keyword argument {name!r} belongs to the {' and the '.join(owners)}: rename it in one of them"
                )
            own[owners[0]][name] = value
        return cls(
            task=dataclasses.replace(chosen, **own["task"]),
            robot=RobotModel.load(robot, ee_frame, **own["robot"]),
            backend=backend,
            settings=own["backend"],
            actions=ActionSettings(**own["actions"]),
            sensors=SensorSettings(**own["sensors"]),
            rendering=RenderSettings(**own["rendering"]),
            pixels=PixelSettings(**own["observation"]),
        )


def _unknown_keyword(name: str, valid: set[str], backend: str) -> GymMaraError:
    """The error for a keyword argument that no part of an environment knows.

    The other backends are asked only if it is no misspelt name of this environment: that imports their engines.
    """
    misspelt = difflib.get_close_matches(name, valid, n=1, cutoff=_ALIKE)
    for other in () if misspelt else backend_names():
        if other == backend:
            continue
        with suppress(Exception):  # it is not installed, or its engine cannot be imported
            if name in backend_settings(other):
                return GymMaraError(
                    f"unknown keyword argument {name!r} with backend {backend!r}: it is a setting of the backend "
                    f"{other!r}; pass backend={other!r}, or leave {name!r} out"
                )
    return unknown("keyword argument", name, valid, f" with backend {backend!r}")


def _own_names(receiver: type[object] | None) -> set[str]:
    """The named arguments of the constructors of an environment class of this package, and of its base classes."""
    if receiver is None:
        return {"backend", "ee_frame", "robot", "task"}
    own = [
        c for c in receiver.__mro__ if c.__module__.startswith("gym_mara") and "__init__" in vars(c)
    ]
    parameters = [p for c in own for p in inspect.signature(c).parameters.values()]
    return {p.name for p in parameters if p.kind is not p.VAR_KEYWORD}


def check_reset_options(options: Any, known: Sequence[str]) -> None:
    """Check the keys of `reset(options=…)`.

    Raises:
        GymMaraError: one is unknown, or the options are no dictionary.
    """
    if not options:
        return
    if not isinstance(options, Mapping):
        raise GymMaraError(f"the options of reset must be a dictionary or None, not {options!r}")
    for key in options:
        if not known:
            raise GymMaraError(f"unknown option of reset {key!r}: this environment has none")
        one_of("option of reset", key, known)


def _names(form: Any) -> list[str]:
    """The names of a dataclass's fields."""
    return [field.name for field in dataclasses.fields(form)]
