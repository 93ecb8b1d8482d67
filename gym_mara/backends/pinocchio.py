"""The kinematic backend: joints move to their targets without forces; Coal or python-fcl checks for collisions."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from gym_mara.backends.base import Backend, limited_velocity, stated_velocity
from gym_mara.backends.servo_motion import servo_motion
from gym_mara.collision import make_checker
from gym_mara.collision.base import CollisionChecker
from gym_mara.collision.cached import CachedChecker
from gym_mara.collision.coal import CoalChecker, ParallelCoalChecker
from gym_mara.errors import positive_number
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import SimState
from gym_mara.types import Floats, Mask

CACHE_FROM = 16
"""From this number of arms on a cached checker is faster."""
_STATE = ("q", "qd", "time", "collided", "touching")


class PinocchioBackend(Backend):
    """Kinematics without dynamics.

    By default the joints reach their targets within a step and rest there (gym-gazebo2's training mode). With
    `max_joint_velocity` each joint moves at this velocity, or at the URDF's limit where that is lower, until it arrives (its run
    mode), and the arm stops where its path first collides. With `servo_gain` each joint follows the law of the dynamic
    backends' position servos, without their mass (`gym_mara.backends.servo_motion`), along a path checked in the same way.

    Args:
        robot: the arm.
        num_envs: the number of arms.
        control_period: s.
        max_joint_velocity: rad/s (m/s for a prismatic joint), where it is below the URDF's limits; None for those, or
            without `servo_gain` for joints that teleport.
        servo_gain: 1/s; None for joints without the law of a servo.
        collision: the collision engine: "coal" (the faster), "fcl", or "none" for no collisions.
        collision_threads: how many threads Coal uses; worth it for large batches on idle cores.
        path_resolution: the longest way of any point of the arm between two checks along a path, m.

    Raises:
        GymMaraError: a setting is out of its range, or a joint that does not teleport has a velocity limit of zero.
        MissingExtraError: the collision engine is not installed.
    """

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        max_joint_velocity: float | None = None,
        servo_gain: float | None = None,
        collision: str = "coal",
        collision_threads: int = 1,
        path_resolution: float = 0.005,
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        self.teleports = max_joint_velocity is None and servo_gain is None
        if servo_gain is not None:
            self.servo_gain = positive_number("servo_gain", servo_gain, "1/s")
        if not self.teleports:
            self.joint_velocity = limited_velocity(robot, max_joint_velocity)
        else:
            self.joint_velocity = stated_velocity(robot.velocity_limit)
        self._furthest = self.joint_velocity * self.control_period
        self.path_resolution = positive_number(
            "path_resolution",
            path_resolution,
            "m",
            at_least=1e-4,
            reason="a path has a collision check for each, and all are computed at once",
        )
        self._checker = make_checker(collision, robot, collision_threads)
        self._with_margin: CollisionChecker | None = None
        if not self.teleports:
            self._with_margin = self._checker.with_margin(0.5 * self._furthest)
        elif num_envs >= CACHE_FROM and isinstance(
            self._checker, (CoalChecker, ParallelCoalChecker)
        ):
            self._checker = CachedChecker(robot, self._checker)
        self._kinematics = robot.kinematics()
        self._q = np.tile(robot.home, (num_envs, 1))
        self._qd = np.zeros_like(self._q)
        self._time = np.zeros(num_envs)
        self._period = np.array(self.control_period)  # NumPy adds it faster than a Python number
        self._collided = np.zeros(num_envs, dtype=np.bool_)
        # The arms that were put somewhere since the last check, which is made when it is asked for; None for none.
        self._unchecked: Mask | None = np.ones(num_envs, dtype=np.bool_)
        self._touching = np.zeros(num_envs, dtype=np.bool_)

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        rows: Any = slice(None) if mask is None else mask
        self._q[rows] = q[rows]
        self._qd[rows] = 0.0
        self._time[rows] = 0.0
        self._touching[rows] = False
        if mask is None or self._unchecked is None:
            self._unchecked = np.zeros(self.num_envs, np.bool_)
        self._unchecked[rows] = True

    def step(self, q_target: Floats) -> SimState:
        if self.teleports:
            self._q[...] = q_target
            self._collided = self._checker.check(self._q)
        else:
            self._travel(q_target)
        self._unchecked = None
        self._time += self._period
        return self.state

    def _travel(self, q_target: Floats) -> None:
        """Move along the path of one period, up to the first collision on it."""
        way, furthest = q_target - self._q, self._furthest
        # Joints are fastest at the beginning: a servo's joint at gain times its way, or at the limit.
        initial = 1.0 if self.servo_gain is None else self.servo_gain * self.control_period
        length = (np.minimum(initial * np.abs(way), furthest) * self.robot.reach).sum(1)
        samples = np.maximum(1, np.ceil(length / self.path_resolution)).astype(np.int64)
        free = np.zeros(self.num_envs, np.bool_)
        if self._with_margin is not None:
            # A path is free where the arm, at the middle of it, is far enough from everything.
            long = samples > 1
            middle = self._q[long] + 0.5 * self._moved(way[long], np.array(1.0))
            free[long] = ~self._with_margin.check(middle)
            samples[free] = 1
        # The samples of all paths in one array, arm after arm: the arm, and the number of the sample on its path.
        arm = np.repeat(np.arange(self.num_envs), samples)
        last = np.cumsum(samples) - 1
        sample = np.arange(1, len(arm) + 1) - (last - samples + 1)[arm]
        part = (sample / samples[arm])[:, None]
        path = self._q[arm] + self._moved(way[arm], part)
        if self.servo_gain is None:
            arrived = np.abs(way[arm]) <= furthest * part * (1.0 + 1e-9)
            path[arrived] = q_target[arm][arrived]  # exactly, without rounding
        else:
            path = np.minimum(np.maximum(path, self.robot.lower), self.robot.upper)
        hit, unsure = np.zeros(len(arm), np.bool_), ~free[arm]
        hit[unsure] = self._checker.check(path[unsure])
        first_hit = np.minimum.reduceat(
            np.where(hit, np.arange(len(arm)), len(arm)), last - samples + 1
        )
        # An arm that already collided moves on, whatever it touches; any other stops where it first collides.
        stop = np.where(self._touching, last, np.minimum(first_hit, last))
        collided = first_hit <= last
        self._q = path[stop]
        resting = (self._q == q_target) | (collided & ~self._touching)[:, None]
        self._qd = np.where(resting, 0.0, self._velocity(way, q_target))
        self._collided, self._touching = collided, collided.copy()

    def _moved(self, way: Floats, part: Floats) -> Floats:
        """How far joints (..., J) on their way to their targets have moved after a part of a period."""
        if self.servo_gain is None:
            limit = self._furthest * part
            return np.clip(way, -limit, limit)
        time = self.control_period * part
        gain = np.array(self.servo_gain)
        return servo_motion(np.zeros(()), way, gain, self.joint_velocity, time)

    def _velocity(self, way: Floats, q_target: Floats) -> Floats:
        """The velocities (N, J) of joints that have been on their way for one period."""
        if self.servo_gain is None:
            return np.sign(way) * self.joint_velocity
        wanted = self.servo_gain * (q_target - self._q)
        return np.clip(wanted, -self.joint_velocity, self.joint_velocity)

    @property
    def state(self) -> SimState:
        self._check_where_reset()
        position, quaternion = self._kinematics.pose(self._q)
        if self.teleports:  # at rest
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

    def _check_where_reset(self) -> None:
        """Find out which of the arms that were put somewhere collide there."""
        if self._unchecked is not None:
            here = self._checker.check(self._q)  # of all arms, as CachedChecker needs
            self._collided = np.where(self._unchecked, here, self._collided)
            self._unchecked = None

    def save(self) -> dict[str, Any]:
        self._check_where_reset()
        return {name: copy.copy(getattr(self, f"_{name}")) for name in _STATE}

    def restore(self, snapshot: dict[str, Any]) -> None:
        # 0.2.0 saved None right after a reset, before it had checked the arms.
        unchecked = snapshot.get("collided", False) is None
        if unchecked:
            snapshot = snapshot | {"collided": np.zeros_like(self._collided)}
        check_fits("backend", snapshot, {name: getattr(self, f"_{name}") for name in _STATE})
        for name in _STATE:
            setattr(self, f"_{name}", copy.copy(snapshot[name]))
        self._unchecked = np.ones_like(self._collided) if unchecked else None
