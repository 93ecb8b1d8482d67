"""Backends: engines that move the arms, behind one contract."""

from gym_mara.backends.base import Backend
from gym_mara.backends.registry import (
    DEFAULT_BACKEND,
    backend_names,
    backend_settings,
    installed_backends,
    make_backend,
    simulated_backends,
    usable_backends,
)

__all__ = [
    "DEFAULT_BACKEND",
    "Backend",
    "backend_names",
    "backend_settings",
    "installed_backends",
    "make_backend",
    "simulated_backends",
    "usable_backends",
]
