"""Trajectories made by hand."""

from __future__ import annotations

from typing import Any

import numpy as np

from gym_mara.agents.evaluation.rollout import Trajectory

PERIOD = 0.1
JOINTS = 2


def trajectory(**changes: Any) -> Trajectory:
    """Episodes at rest at the target in every step; the changes set the number of steps and of arms.

    Two joints have the velocity limits 1 and 2 rad/s, and the effort limits 10 and 20 Nm.
    """
    steps, arms = next(np.shape(v)[:2] for k, v in changes.items() if k not in ("start", "period"))
    zeros, joints = np.zeros((steps, arms)), np.zeros((steps, arms, JOINTS))
    values: dict[str, Any] = {
        "period": PERIOD,
        "velocity_limit": np.array([1.0, 2.0]),
        "effort_limit": np.array([10.0, 20.0]),
        "start": np.zeros((arms, JOINTS)),
        "target": np.zeros((arms, 3)),
        "steps": zeros == 0.0,
        "q": joints,
        "qd": joints,
        "torque": joints,
        "tool": np.zeros((steps, arms, 3)),
        "position_error": zeros,
        "angle_error": zeros,
        "success": np.full_like(zeros, np.nan),
        "reward": zeros,
        "collided": zeros > 0.0,
        "action": joints,
    }
    return Trajectory(**(values | changes))
