"""The dynamic backend on MuJoCo."""

from gym_mara.backends.mujoco.backend import MujocoBackend

__all__ = ["MujocoBackend"]
