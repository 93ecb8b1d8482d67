"""Trained policies on a robot: exported files of `gym-mara export`, played with NumPy and onnxruntime alone."""

from gym_mara.deploy.about import About
from gym_mara.deploy.policy import OnnxPolicy

__all__ = ["About", "OnnxPolicy"]
