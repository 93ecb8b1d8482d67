"""Limited motion: set-points that keep velocity, acceleration and jerk within limits, and the stop from each of them.

Ruckig computes both. Units are those of the joints: rad, or m for a prismatic joint.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from gym_mara.backends.base import limited_velocity
from gym_mara.errors import LARGEST, GymMaraError, finite_numbers, positive_number
from gym_mara.robot import RobotModel
from gym_mara.ros2.safety.planners import (
    JointPlanner,
    LinePlanner,
    Numbers,
    Planner,
    State,
    StopPlanner,
)
from gym_mara.types import Floats

VELOCITY_TIME = 0.2
"""The default acceleration limit reaches the velocity limit in this time, s."""
ACCELERATION_TIME = 0.1
"""The default jerk limit reaches the acceleration limit in this time, s."""
_LONGEST = 60.0
"""A target is cut to where a joint gets in this time at its velocity limit, s: Ruckig plans only some hours ahead."""
_ROUNDING = 1e-9
"""By how much a computed path may be beyond a limit, rad (m). Set-points are clipped."""


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """The limits of a motion, each (J,).

    Raises:
        GymMaraError: a limit is not positive, or the three are not of equally many joints.
    """

    velocity: Floats
    """rad/s (m/s)."""
    acceleration: Floats
    """rad/s² (m/s²)."""
    jerk: Floats
    """rad/s³ (m/s³)."""

    def __post_init__(self) -> None:
        for field in fields(self):
            values = finite_numbers(field.name, getattr(self, field.name), len(self.velocity))
            array = np.array([positive_number(field.name, value) for value in values])
            array.flags.writeable = False
            object.__setattr__(self, field.name, array)

    @classmethod
    def of(
        cls,
        robot: RobotModel,
        max_joint_velocity: float | None = None,
        max_joint_acceleration: float | None = None,
        max_joint_jerk: float | None = None,
    ) -> MotionLimits:
        """The limits for a robot.

        A URDF has limits of velocity alone. By default a joint reaches its velocity limit in VELOCITY_TIME at its acceleration
        limit, and that limit in ACCELERATION_TIME at its jerk limit. Give the arm's own values where they are lower.

        Args:
            robot: the arm.
            max_joint_velocity: rad/s (m/s), where it is below the robot's limits; None for those.
            max_joint_acceleration: of every joint, rad/s² (m/s²).
            max_joint_jerk: of every joint, rad/s³ (m/s³).

        Raises:
            GymMaraError: a limit is no positive number, or a joint has no velocity limit, or one of zero.
        """
        velocity = limited_velocity(robot, max_joint_velocity)
        if (velocity >= LARGEST).any():
            joint = robot.joint_names[int(velocity.argmax())]
            raise GymMaraError(
                f"joint {joint} of {robot.name} has no velocity limit, and the arm may not move without: give "
                "max_joint_velocity, rad/s (m/s)"
            )
        acceleration = velocity / VELOCITY_TIME
        if max_joint_acceleration is not None:
            number = positive_number("max_joint_acceleration", max_joint_acceleration, "rad/s²")
            acceleration = np.full_like(velocity, number)
        jerk = acceleration / ACCELERATION_TIME
        if max_joint_jerk is not None:
            jerk = np.full_like(
                velocity, positive_number("max_joint_jerk", max_joint_jerk, "rad/s³")
            )
        return cls(velocity, acceleration, jerk)

    def duration(self, way: Floats, share: float = 1.0) -> float:
        """The time of a straight motion from rest to rest, s; an upper bound where it is too short to reach all limits.

        It is L/v + v/a + a/j, of a profile with seven phases of constant jerk on a line of the length L.

        Args:
            way: of each joint (J,), rad (m).
            share: the velocity limit, as a share of the full one.
        """
        # The inverse limits on the line, whose length is 1: that of the joint that is limited most.
        v, a, j = (
            float((np.abs(way) / limit).max())
            for limit in (share * self.velocity, self.acceleration, self.jerk)
        )
        return v + a / v + j / a if v else 0.0


class Motion:
    """A moving set-point, and the proved stop from it.

    A tick is `propose`, a look at the proposed path by the caller, then `accept` or, in its place, `follow_stop`. What was
    accepted always has a stop, so the arm can follow it at any later tick without a new plan. From rest the joints move on a
    straight line to a target, as long as that does not change.

    Args:
        limits: of velocity, acceleration and jerk.
        lower, upper: the position limits (J,), which may be infinite.
        period: the time of a tick, s.
    """

    q: list[float]
    """The set-point's position (J,)."""
    qd: list[float]
    """Its velocity (J,)."""
    qdd: list[float]
    """Its acceleration (J,)."""
    resting: bool
    """Whether it is at rest."""
    extremes: list[tuple[float, float]]
    """The lowest and the highest position of each joint on the proposed stop (J,)."""

    def __init__(self, limits: MotionLimits, lower: Floats, upper: Floats, period: float) -> None:
        self.period = period
        self.velocity: list[float] = limits.velocity.tolist()
        self.acceleration: list[float] = limits.acceleration.tolist()
        self.jerk: list[float] = limits.jerk.tolist()
        self._limits = list(zip(lower.tolist(), upper.tolist(), strict=True))
        own = self.velocity, self.acceleration, self.jerk
        self._joints, self._line = JointPlanner(*own, period), LinePlanner(*own, period)
        self._planner: Planner = self._joints
        self._stopper = StopPlanner(*own)
        self._stop, self._next_stop = self._stopper.trajectory(), self._stopper.trajectory()
        self._stop_time = 0.0
        self.rest_at(self.clip([0.0] * len(self.velocity)))

    def rest_at(self, q: Numbers) -> None:
        """Put the set-point at rest at q (J,)."""
        self.q, still = list(q), [0.0] * len(self.velocity)
        self.qd, self.qdd = still, still
        self.resting, self._stop_time = True, 0.0
        self._joints.forget()
        self._stopper.plan((self.q, still, still), self._stop)

    def clip(self, target: Numbers) -> list[float]:
        """The target within the position limits."""
        return [min(max(x, a), b) for x, (a, b) in zip(target, self._limits, strict=True)]

    def propose(self, target: Numbers, share: float) -> bool:
        """Plan the next set-point towards a target within the limits, and the stop from there.

        Args:
            target: where the joints shall come to rest (J,).
            share: the velocity limit, as a share of the full one.

        Returns:
            Whether the stop keeps the position limits.

        Raises:
            NoTrajectoryError: there is none.
        """
        line, state = self._line, (self.q, self.qd, self.qdd)
        self._target = near = [
            min(max(x, q - _LONGEST * v), q + _LONGEST * v)
            for x, q, v in zip(target, self.q, self.velocity, strict=True)
        ]
        if self.resting and near != self.q:
            line.begin(self.q, near)
            self._planner = line
        elif self.resting or near != line.target:
            self._planner = self._joints
        self._next = self._planner.plan(state, near, share)
        self._stopper.plan(self._next, self._next_stop)
        self.extremes = self._extremes()
        return all(
            low >= a - _ROUNDING and high <= b + _ROUNDING
            for (low, high), (a, b) in zip(self.extremes, self._limits, strict=True)
        )

    def _extremes(self) -> list[tuple[float, float]]:
        """The lowest and the highest position of each joint on the proposed stop.

        Ruckig's position_extrema is not used: with a velocity as the aim it reports positions of 0 that are not on the way.
        """
        end = self._next_stop.at_time(self.stop_duration)[0]
        found = []
        for q, v, a, last, j in zip(*self._next, end, self.jerk, strict=True):
            low, high = (q, last) if q < last else (last, q)
            if v * a < 0.0 and a * a > 2.0 * j * abs(v):
                # It brakes so hard that it turns before the jerk has ended that: at the first root of v + a t ± j t² / 2.
                t = (abs(a) - math.sqrt(a * a - 2.0 * j * abs(v))) / j
                turn = q + t * (v + t * (0.5 * a - math.copysign(j * t, a) / 6.0))
                low, high = min(low, turn), max(high, turn)
            found.append((low, high))
        return found

    @property
    def stop_duration(self) -> float:
        """How long the proposed stop takes, s."""
        return float(self._next_stop.duration)

    def proposed(self, time: float) -> State:
        """Position, velocity and acceleration on the proposed path, each (J,).

        Args:
            time: from the proposed set-point, s. Before it, down to minus a period, the arm is on its way there; after it,
                the arm stops.
        """
        if time < 0.0:
            return self._planner.before(-time)
        return self._next_stop.at_time(time)  # type: ignore[no-any-return]

    def accept(self) -> None:
        """Make the proposal the set-point."""
        if self._planner.finished:
            self.rest_at(self._target)  # exactly, without rounding
            return
        self._stop, self._next_stop, self._stop_time = self._next_stop, self._stop, 0.0
        self.resting = False
        q, self.qd, self.qdd = self._next
        self.q = self.clip(q)
        if self._planner is self._line:
            self._line.advance()

    def follow_stop(self) -> bool:
        """Move the set-point along its stop for a period; returns whether it rests there."""
        self._stop_time += self.period
        self._planner = self._joints  # the set-point leaves the line
        duration = self._stop.duration
        ended = bool(self._stop_time >= duration)
        q, self.qd, self.qdd = self._stop.at_time(duration if ended else self._stop_time)
        self.q = self.clip(q)
        if ended:
            self.rest_at(self.q)
        return ended
