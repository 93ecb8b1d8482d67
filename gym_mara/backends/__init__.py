"""The backends by name: those below, and any that another package offers as an entry point `gym_mara.backends`."""

from __future__ import annotations

import importlib
import inspect
from importlib.metadata import entry_points
from typing import Any

from gym_mara.backends.base import Backend
from gym_mara.backends.workers import WorkerBackend, choose_workers
from gym_mara.errors import unknown
from gym_mara.robot import RobotModel

__all__ = ["DEFAULT_BACKEND", "Backend", "backend_names", "backend_settings", "make_backend"]

DEFAULT_BACKEND = "pinocchio"

# Imported when first used: "module:class".
_BACKENDS = {
    "pinocchio": "gym_mara.backends.pinocchio:PinocchioBackend",
    "dart": "gym_mara.backends.dart:DartBackend",
}


def _all_backends() -> dict[str, str]:
    return {e.name: e.value for e in entry_points(group="gym_mara.backends")} | _BACKENDS


def backend_names() -> list[str]:
    """Every name that `make_backend` knows."""
    return sorted(_all_backends())


def backend_class(name: str) -> type[Backend]:
    """The class of the backend of this name, its module imported.

    Raises:
        GymMaraError: no backend has this name.
        MissingExtraError: its engine is not installed.
    """
    # An entry point is only asked for where the name is not one of ours: the look-up reads the disk.
    target = _BACKENDS.get(name) or _all_backends().get(name)
    if target is None:
        raise unknown("backend", name, backend_names())
    module, _, attribute = target.partition(":")
    backend: type[Backend] = getattr(importlib.import_module(module), attribute)
    return backend


def backend_settings(name: str) -> list[str]:
    """The keyword arguments of the backend of this name.

    Raises:
        GymMaraError: no backend has this name.
        MissingExtraError: its engine is not installed.
    """
    backend = backend_class(name)
    parameters = inspect.signature(backend).parameters.values()
    settings = [p.name for p in parameters if p.kind is p.KEYWORD_ONLY]
    return settings + ["workers"] * backend.in_processes


def make_backend(
    name: str,
    robot: RobotModel,
    num_envs: int,
    options: dict[str, Any],
) -> Backend:
    """A backend of this name for N arms, with settings of its own.

    Args:
        name: the backend.
        robot: the arm.
        num_envs: N.
        options: the settings.

    Raises:
        GymMaraError: the name or a setting is unknown, or a setting is out of its range.
        MissingExtraError: its engine is not installed.
    """
    backend, settings = backend_class(name), backend_settings(name)
    for option in options:
        if option not in settings:
            raise unknown("keyword argument", option, settings, f" with backend {name!r}")
    if not backend.in_processes:
        return backend(robot, num_envs, **options)
    options = dict(options)
    workers = choose_workers(num_envs, options.pop("workers", None))
    if workers == 1:
        return backend(robot, num_envs, **options)
    return WorkerBackend(backend, robot, num_envs, workers, options)
