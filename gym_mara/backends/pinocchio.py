"""The kinematic backend: joints go where they are told, Pinocchio says where that is, FCL or Coal what they hit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.base import Backend
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.collision import make_checker
from gym_mara.state import SimState

Floats = NDArray[np.float64]


class PinocchioBackend(Backend):
    """Kinematics without dynamics.

    By default the joints are at their targets at once, and at rest there (gym-gazebo2's training mode). With
    `max_joint_velocity` each moves at most that far a period, and rests when it arrives (its run mode); the arm stops
    where its path first collides.

    Args:
        robot: the arm.
        num_envs: how many of it.
        control_period: s.
        max_joint_velocity: rad/s (m/s for a prismatic joint); None for teleports.
        collision: the collision engine: "coal" (the faster), "fcl", or "none" to see no collisions.
        collision_threads: how many threads Coal may use; worth it for large batches on idle cores.
        path_resolution: how far, m, any point of the arm moves at most between two checks along a path.
    """

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        max_joint_velocity: float | None = None,
        collision: str = "coal",
        collision_threads: int = 1,
        path_resolution: float = 0.005,
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        if max_joint_velocity is not None and not 0.0 < max_joint_velocity < np.inf:
            raise GymMaraError(
                f"max_joint_velocity must be positive and finite (rad/s), or None for teleports; "
                f"not {max_joint_velocity!r}"
            )
        if not 0.0 < path_resolution < np.inf:
            raise GymMaraError(f"path_resolution must be positive (m), not {path_resolution!r}")
        self.max_joint_velocity = max_joint_velocity
        if max_joint_velocity is not None:
            self.joint_velocity = np.full(robot.num_joints, float(max_joint_velocity))
        self.path_resolution = path_resolution
        self._checker = make_checker(collision, robot, collision_threads)
        self._kinematics = robot.kinematics()
        self._q = np.tile(robot.home, (num_envs, 1))
        self._qd = np.zeros_like(self._q)
        self._time = np.zeros(num_envs)
        self._collided: NDArray[np.bool_] | None = None

    def reset(self, q: Floats, mask: NDArray[np.bool_] | None = None) -> None:
        rows = True if mask is None else mask[:, None]
        np.copyto(self._q, q, where=rows)
        np.copyto(self._qd, 0.0, where=rows)
        np.copyto(self._time, 0.0, where=True if mask is None else mask)
        self._collided = None

    def step(self, q_target: Floats) -> SimState:
        if self.max_joint_velocity is None:
            self._q[...] = q_target
            self._qd[...] = 0.0
            self._collided = self._checker.check(self._q)
        else:
            self._travel(q_target, self.max_joint_velocity)
        self._time += self.control_period
        return self.state

    def _travel(self, q_target: Floats, velocity: float) -> None:
        """Move along the path of one period, as far as the first collision on it."""
        way = q_target - self._q
        samples = self._samples(np.minimum(np.abs(way), velocity * self.control_period))
        times = self.control_period * np.arange(1, samples + 1) / samples
        limits = (velocity * times)[:, None, None]
        path = self._q + np.clip(way, -limits, limits)
        path = np.where(np.abs(way) <= limits, q_target, path)  # exactly there, not nearly
        hits = self._checker.check(path.reshape(-1, self.robot.num_joints)).reshape(samples, -1)
        collided = np.asarray(hits.any(axis=0))
        self._collided = collided
        stop = np.where(collided, hits.argmax(axis=0), samples - 1)
        self._q = path[stop, np.arange(self.num_envs)]
        self._qd = np.where(self._q == q_target, 0.0, np.sign(way) * velocity)

    def _samples(self, steps: Floats) -> int:
        """In how many pieces to check a path whose joints move this far (N, J)."""
        furthest = (steps * self.robot.reach).sum(axis=1).max()
        return max(1, int(np.ceil(furthest / self.path_resolution)))

    @property
    def state(self) -> SimState:
        if self._collided is None:
            self._collided = self._checker.check(self._q)
        position, quaternion = self._kinematics.pose(self._q)
        if self.max_joint_velocity is None:  # at rest
            velocity = np.zeros((self.num_envs, 3))
        else:
            velocity = self._kinematics.velocity(self._q, self._qd)
        return SimState(
            q=self._q.copy(),
            qd=self._qd.copy(),
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=velocity,
            collided=self._collided.copy(),
            time=self._time.copy(),
        )

    def save(self) -> dict[str, Any]:
        return {
            "q": self._q.copy(),
            "qd": self._qd.copy(),
            "time": self._time.copy(),
            "collided": None if self._collided is None else self._collided.copy(),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        self._q = snapshot["q"].copy()
        self._qd = snapshot["qd"].copy()
        self._time = snapshot["time"].copy()
        collided = snapshot["collided"]
        self._collided = None if collided is None else collided.copy()
