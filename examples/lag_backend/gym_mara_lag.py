"""The backend "lag": each joint closes the distance to its target exponentially, as a servo without mass does."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from gym_mara.backends import Backend
from gym_mara.collision import make_checker
from gym_mara.errors import positive_number
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import SimState
from gym_mara.types import Floats, Mask

_STATE = ("q", "qd", "time")


class LagBackend(Backend):
    """First-order lag: q̇ = (q_target - q) / time_constant. Collisions are checked at the end of each step.

    Args:
        robot: the arm.
        num_envs: the number of arms.
        control_period: s.
        time_constant: s; after this time 37 % of the distance is left.

    Raises:
        GymMaraError: a setting is out of its range.
    """

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        time_constant: float = 0.1,
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        self.time_constant = positive_number("time_constant", time_constant, "s", at_least=1e-3)
        # A joint is fastest right after its target has moved from one limit to the other.
        self.joint_velocity = (robot.upper - robot.lower) / self.time_constant
        self._checker = make_checker("coal", robot)
        self._kinematics = robot.kinematics()
        self._q = np.tile(robot.home, (num_envs, 1))
        self._qd = np.zeros_like(self._q)
        self._time = np.zeros(num_envs)

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        """Put arms at rest at q."""
        chosen = slice(None) if mask is None else mask
        self._q[chosen] = q[chosen]
        self._qd[chosen] = 0.0
        self._time[chosen] = 0.0

    def step(self, q_target: Floats) -> SimState:
        """Move for one control period."""
        left = (q_target - self._q) * np.exp(-self.control_period / self.time_constant)
        self._q = q_target - left
        self._qd = left / self.time_constant
        self._time += self.control_period
        return self.state

    @property
    def state(self) -> SimState:
        """The current state."""
        position, quaternion = self._kinematics.pose(self._q)
        return SimState(
            q=self._q.copy(),
            qd=self._qd.copy(),
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=self._kinematics.velocity(self._q, self._qd),
            collided=self._checker.check(self._q),
            time=self._time.copy(),
        )

    def save(self) -> dict[str, Any]:
        """A snapshot of all arms."""
        return {name: getattr(self, f"_{name}").copy() for name in _STATE}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Return to a snapshot."""
        check_fits("backend", snapshot, self.save())
        for name, value in copy.deepcopy(snapshot).items():
            setattr(self, f"_{name}", value)
