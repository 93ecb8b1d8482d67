"""The dynamic backend on DART."""

from gym_mara.backends.dart.backend import DartBackend

__all__ = ["DartBackend"]
