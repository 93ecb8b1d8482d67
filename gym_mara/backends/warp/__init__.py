"""The backend on MuJoCo Warp, which moves thousands of arms on a GPU."""

from gym_mara.backends.warp.backend import WarpBackend

__all__ = ["WarpBackend"]
