"""Trajectories of joints: checked points by name, and the ways between them over time. Nothing here needs ROS."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from gym_mara.errors import LARGEST, GymMaraError
from gym_mara.types import Floats


class Point(NamedTuple):
    """A point of a trajectory as it comes, its joints in the order of the trajectory's names."""

    position: Sequence[float]
    """rad (m)."""
    velocity: Sequence[float]
    """rad/s (m/s); empty for none."""
    time: float
    """After the start, s."""


class Trajectory(NamedTuple):
    """Points in the order of a robot's joints, all finite, at times that increase."""

    times: Floats
    """After the start (K,), s."""
    q: Floats
    """Joint positions (K, J), rad (m)."""
    qd: Floats | None
    """Joint velocities (K, J), rad/s (m/s); None where a point has none."""

    @classmethod
    def of(
        cls, joint_names: Sequence[str], names: Sequence[str], points: Sequence[Point]
    ) -> Trajectory:
        """Check the points of a trajectory and bring them into an order of joints.

        Args:
            joint_names: of the robot (J,).
            names: of the joints in the points.
            points: at least one.

        Raises:
            GymMaraError: the names are not those of the robot's joints, each once; or a point is not complete and finite, or
                its time is negative or does not increase.
        """
        if sorted(names) != sorted(joint_names):
            missing = [name for name in joint_names if name not in names]
            strange = [name for name in names if name not in joint_names]
            wrong = f"{', '.join(missing)} missing" if missing else "a joint is there twice"
            wrong = f"{', '.join(strange)} unknown" if strange else wrong
            raise GymMaraError(
                f"a trajectory must name each joint once, {', '.join(joint_names)}: {wrong}"
            )
        order = [list(names).index(name) for name in joint_names]
        times = _finite("the times of a trajectory's points", [point.time for point in points])
        if not points or times[0] < 0.0 or not (np.diff(times) > 0.0).all():
            raise GymMaraError(
                "the times of a trajectory's points must increase, and not be negative"
            )
        count = len(joint_names)
        q = np.stack([row(point.position, count, "position") for point in points])[:, order]
        qd = None
        if all(len(point.velocity) for point in points):
            qd = np.stack([row(point.velocity, count, "velocity") for point in points])[:, order]
        elif any(len(point.velocity) for point in points):
            raise GymMaraError("either all points of a trajectory have velocities or none")
        return cls(times, q, qd)


def row(values: Sequence[float], count: int, what: str) -> Floats:
    """The values of each joint (J,).

    Raises:
        GymMaraError: they are not as many finite numbers.
    """
    if len(values) != count:
        raise GymMaraError(f"a command has {len(values)} values of {what}, and the arm {count}")
    return _finite(f"the values of {what} of a command", values)


def _finite(what: str, values: ArrayLike) -> Floats:
    array = np.asarray(values, np.float64)
    if not bool((np.abs(array) <= LARGEST).all()):
        raise GymMaraError(f"{what} must be finite, not {array}")
    return array


class Goal(NamedTuple):
    """Where each joint shall be, and how fast it moves there by itself, in the order of a robot's joints, all finite."""

    q: Floats
    """Joint positions (J,), rad (m)."""
    speed: Floats
    """Not negative (J,), rad/s (m/s)."""

    @classmethod
    def of(cls, joint_names: Sequence[str], names: Sequence[str], points: Sequence[Point]) -> Goal:
        """The goal of a trajectory, of which the first point counts, without its time.

        Raises:
            GymMaraError: as in `Trajectory.of`, or the point has no velocities.
        """
        first = Trajectory.of(
            joint_names, names, [point._replace(time=0.0) for point in points[:1]]
        )
        if first.qd is None:
            raise GymMaraError(
                "a command to the servos of 2019 must have a velocity for each joint, rad/s: how fast it moves to its position"
            )
        return cls(first.q[0], np.abs(first.qd[0]))


class Way(Protocol):
    """How a reference moves."""

    end: float
    """The time at its end, s, where it rests; infinite for never."""

    def at(self, time: float) -> tuple[Floats, Floats]:
        """The position and the velocity of the reference (J,), rad (m) and rad/s (m/s)."""


class ServoWay:
    """The way of a reference to a goal, each joint by itself at its own speed, as MARA's servos move.

    Args:
        now: the time, s.
        q: where the reference is (J,), rad (m).
        goal: where it shall be.
    """

    def __init__(self, now: float, q: Floats, goal: Goal) -> None:
        self._start, self._q, self._goal = now, q, goal
        self._way = goal.q - q
        times = np.zeros(len(q))
        moving = self._way != 0.0
        with np.errstate(divide="ignore", over="ignore"):  # at no speed it never arrives
            times[moving] = np.abs(self._way[moving]) / goal.speed[moving]
        self._times = times
        self.end = now + float(times.max())

    def at(self, time: float) -> tuple[Floats, Floats]:
        """As in `Way`."""
        passed = time - self._start
        arrived = self._times <= passed
        velocity = np.where(arrived, 0.0, np.copysign(self._goal.speed, self._way))
        return np.where(arrived, self._goal.q, self._q + passed * velocity), velocity


class Path:
    """The way of a reference from where it is, through the points of a trajectory, and its rest at the last one.

    Between two points the reference is a cubic polynomial where the trajectory has velocities, else it moves at a constant
    velocity.

    Args:
        now: the time, s.
        q: where the reference is (J,), rad (m).
        qd: how it moves (J,), rad/s (m/s).
        trajectory: its points. Those before `now` are left out.
        start: the time of its start, s.
    """

    def __init__(
        self, now: float, q: Floats, qd: Floats, trajectory: Trajectory, start: float
    ) -> None:
        times = start + trajectory.times
        first = min(int(np.searchsorted(times, now, side="right")), len(times) - 1)
        self._times = np.concatenate([[min(now, times[-1])], times[first:]])
        self._q = np.concatenate([q[None], trajectory.q[first:]])
        self._qd = None
        if trajectory.qd is not None:
            self._qd = np.concatenate([qd[None], trajectory.qd[first:]])
        self.end = float(times[-1])
        """The time at its last point, s."""

    def at(self, time: float) -> tuple[Floats, Floats]:
        """The position and the velocity of the reference (J,), rad (m) and rad/s (m/s)."""
        if time >= self.end:
            return self._q[-1].copy(), np.zeros(self._q.shape[1])
        after = max(int(np.searchsorted(self._times, time, side="right")), 1)
        before = after - 1
        step = self._times[after] - self._times[before]
        part = (time - self._times[before]) / step
        way = self._q[after] - self._q[before]
        if self._qd is None:
            return self._q[before] + part * way, way / step
        # The cubic Hermite polynomial of positions and velocities at both ends.
        v0, v1 = self._qd[before] * step, self._qd[after] * step
        c2, c3 = 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way
        q = self._q[before] + part * (v0 + part * (c2 + part * c3))
        return q, (v0 + part * (2.0 * c2 + 3.0 * part * c3)) / step
