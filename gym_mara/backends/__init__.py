"""Backends: engines that move the arms, behind one contract."""

from gym_mara.backends.base import Backend
from gym_mara.backends.registry import backend_names, backend_settings, make_backend

__all__ = ["Backend", "backend_names", "backend_settings", "make_backend"]
