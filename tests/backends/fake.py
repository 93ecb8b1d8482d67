"""A backend without an engine, to test environments and tasks: joints teleport, and a wall stands at 1 rad."""

from __future__ import annotations

from typing import Any

import numpy as np

from gym_mara.backends import Backend
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.types import Floats, Mask


class FakeBackend(Backend):
    """Collides where the first joint is beyond `wall`, rad."""

    teleports = True

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        wall: float = 1.0,
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        self.wall = wall
        self.closed = False
        self._q = np.tile(robot.home, (num_envs, 1))
        self._time = np.zeros(num_envs)

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        chosen = slice(None) if mask is None else mask
        self._q[chosen] = q[chosen]
        self._time[chosen] = 0.0

    def step(self, q_target: Floats) -> SimState:
        self._q[...] = q_target
        self._time += self.control_period
        return self.state

    @property
    def state(self) -> SimState:
        position, quaternion = self.robot.kinematics().pose(self._q)
        return SimState(
            q=self._q.copy(),
            qd=np.zeros_like(self._q),
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=np.zeros((self.num_envs, 3)),
            collided=self._q[:, 0] > self.wall,
            time=self._time.copy(),
        )

    def save(self) -> dict[str, Any]:
        return {"q": self._q.copy(), "time": self._time.copy()}

    def restore(self, snapshot: dict[str, Any]) -> None:
        self._q, self._time = snapshot["q"].copy(), snapshot["time"].copy()

    def close(self) -> None:
        self.closed = True
