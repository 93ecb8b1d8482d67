"""The backends by name: those below, and those that other packages offer as entry points `gym_mara.backends`."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from gym_mara.backends.base import Backend
from gym_mara.backends.workers import WorkerBackend, choose_workers
from gym_mara.errors import GymMaraError, unknown, whole_number
from gym_mara.robot import RobotModel


class BrokenBackendError(GymMaraError):
    """Another package offers a backend that cannot be loaded."""


DEFAULT_BACKEND = "pinocchio"
_GROUP = "gym_mara.backends"
# "module:class"; a module is imported when its backend is first used.
_BACKENDS = {
    "pinocchio": "gym_mara.backends.pinocchio:PinocchioBackend",
    "dart": "gym_mara.backends.dart:DartBackend",
    "mujoco": "gym_mara.backends.mujoco:MujocoBackend",
    "warp": "gym_mara.backends.warp:WarpBackend",
    "ros2": "gym_mara.backends.ros2:Ros2Backend",
}
_REAL = ("ros2",)
"""Those that move an arm in the real world, or one that another program simulates."""


def _find(name: str) -> EntryPoint | None:
    if name in _BACKENDS:  # without a look at the entry points: that reads the disk
        return EntryPoint(name, _BACKENDS[name], _GROUP)
    return next(iter(entry_points(group=_GROUP, name=name)), None)


def backend_names() -> list[str]:
    """The names that `make_backend` knows; no engine is imported."""
    return sorted({*_BACKENDS, *(e.name for e in entry_points(group=_GROUP))})


def simulated_backends() -> list[str]:
    """The names of the backends that simulate arms themselves."""
    return [name for name in backend_names() if name not in _REAL]


def backend_class(name: str) -> type[Backend]:
    """The class of a backend; imports its module.

    Raises:
        GymMaraError: no backend has this name.
        BrokenBackendError: another package offers it, and it cannot be loaded.
        MissingExtraError: its engine is not installed.
    """
    entry_point = _find(name) if isinstance(name, str) else None
    if entry_point is None:
        raise unknown("backend", name, backend_names())
    try:
        backend = entry_point.load()
    except GymMaraError:
        raise
    except Exception as error:
        if name in _BACKENDS:
            raise
        raise _broken(entry_point, f"{type(error).__name__}: {error}") from error
    if not (isinstance(backend, type) and issubclass(backend, Backend)):
        raise _broken(entry_point, "not a subclass of gym_mara.backends.Backend")
    return backend


def _broken(entry_point: EntryPoint, reason: str) -> BrokenBackendError:
    package = entry_point.dist.name if entry_point.dist else "another package"
    return BrokenBackendError(
        f"the backend {entry_point.name!r} of {package} cannot be loaded from {entry_point.value!r} ({reason}); "
        "repair or uninstall that package"
    )


def backend_settings(name: str) -> list[str]:
    """The names of a backend's settings, which are keyword arguments of the environments.

    Raises:
        GymMaraError: no backend has this name.
        BrokenBackendError: another package offers it, and it cannot be loaded.
        MissingExtraError: its engine is not installed.
    """
    return list(backend_defaults(name))


def backend_defaults(name: str) -> dict[str, Any]:
    """The values of a backend's settings where none are given, by name.

    Raises:
        GymMaraError: as in `backend_settings`.
    """
    backend = backend_class(name)
    parameters = inspect.signature(backend).parameters.values()
    defaults = {p.name: p.default for p in parameters if p.kind is p.KEYWORD_ONLY}
    return defaults | ({"workers": None} if backend.in_processes else {})


def installed_backends() -> tuple[list[str], list[str]]:
    """The names of the simulated backends that can be imported here, and for each of the others the reason why not."""
    return _those_that(backend_class)


def usable_backends() -> tuple[list[str], list[str]]:
    """The names of the simulated backends that work on this machine by default, and for each of the others the reason why not."""
    return _those_that(lambda name: backend_class(name).require_machine())


def _those_that(check: Callable[[str], object]) -> tuple[list[str], list[str]]:
    """The names of the backends that pass a check, and the errors of the others."""
    passed, reasons = [], []
    for name in simulated_backends():
        try:
            check(name)
            passed.append(name)
        except GymMaraError as error:
            reasons.append(str(error))
    return passed, reasons


def make_backend(
    name: str,
    robot: RobotModel,
    num_envs: int,
    options: dict[str, Any],
) -> Backend:
    """Make a backend for N arms, in worker processes where `in_processes` and `workers` say so.

    Args:
        name: of the backend.
        robot: the arm.
        num_envs: N.
        options: the backend's settings, and `workers` where it runs in processes.

    Raises:
        GymMaraError: the name or a setting is unknown, or a setting is out of its range.
        MissingExtraError: its engine is not installed.
    """
    backend, settings = backend_class(name), backend_settings(name)
    num_envs = whole_number(
        "num_envs",
        num_envs,
        at_most=backend.most_arms,
        reason=f"the backend {name!r} moves one arm"
        if backend.most_arms == 1
        else f"the arms of the backend {name!r} take too much memory",
    )
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
