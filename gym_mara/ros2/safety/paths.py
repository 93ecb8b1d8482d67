"""Whether the path ahead of an arm is free of collisions, at the cost of a few checks."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gym_mara.collision.base import CollisionChecker
from gym_mara.robot import RobotModel
from gym_mara.ros2.safety.motion import Motion
from gym_mara.types import Floats

RESOLUTION = 0.005
"""Between two checks no point of the arm moves further than this, m."""
_COARSE, _FINE = 0.1, 0.025
"""By how much a distance between two links shrinks at most within a ball of the coarse and of the fine level, m."""
_PARTS = round(_COARSE / _FINE)


class PathChecker:
    """Checks the proposed path of a `Motion`: the way to the next set-point, and the stop from there.

    The path is cut into pieces. Where nothing can meet while the joints stay as near to the middle of a piece as they do, the
    piece is free (`CollisionChecker.with_margin`); first large pieces are tried, then small ones. Only what remains is checked
    point by point, every RESOLUTION. An engine without margins has every point checked.

    Args:
        robot: the arm.
        checker: the engine.
        velocity: the velocity limits (J,), rad/s (m/s): pieces are as long in each joint as this is fast.
    """

    def __init__(self, robot: RobotModel, checker: CollisionChecker, velocity: Floats) -> None:
        self._checker = checker
        self._reach: list[float] = robot.reach.tolist()
        # The time in which the whole arm, at full speed, leaves a coarse ball.
        self._time = _COARSE / float((robot.reach * velocity).sum())
        self._coarse = checker.with_margin(self._time * velocity)
        self._fine = checker.with_margin(self._time / _PARTS * velocity)
        self._ball: list[float] = (self._time * velocity).tolist()
        self._centre: list[float] | None = None

    def collides(self, q: Floats) -> bool:
        """Whether the arm collides at q (J,)."""
        return bool(self._checker.check(q[None])[0])

    def first_collision(self, motion: Motion) -> Floats | None:
        """The first configuration (J,) that was found to collide on the proposed path; None if the path is free."""
        if self._in_ball(motion):
            return None
        pieces = self._pieces(motion)
        if self._coarse is not None and self._fine is not None:
            centres = [0.5 * (begin + end) for begin, end, _ in pieces]
            q = _configurations(motion, centres)
            near = self._coarse.check(q).tolist()
            if len(pieces) == 1:
                self._centre = None if near[0] else q[0].tolist()
            if not any(near):
                return None
            pieces = [
                (
                    begin + part * (end - begin) / _PARTS,
                    begin + (part + 1) * (end - begin) / _PARTS,
                    speed,
                )
                for (begin, end, speed), is_near in zip(pieces, near, strict=True)
                if is_near
                for part in range(_PARTS)
            ]
            centres = [0.5 * (begin + end) for begin, end, _ in pieces]
            near = self._fine.check(_configurations(motion, centres)).tolist()
            pieces = [piece for piece, is_near in zip(pieces, near, strict=True) if is_near]
            if not pieces:
                return None
        return self._point_by_point(motion, pieces)

    def _in_ball(self, motion: Motion) -> bool:
        """Whether the whole path is within the ball around the last configuration that was free with the coarse margin."""
        centre = self._centre
        if centre is None:
            return False
        # A joint that turns round within the tick goes beyond its ends by less than this.
        turn = 0.125 * motion.period**2
        for q, extreme, middle, radius, a in zip(
            motion.q, motion.extremes, centre, self._ball, motion.acceleration, strict=True
        ):
            room = radius - turn * a
            if min(q, extreme[0]) < middle - room or max(q, extreme[1]) > middle + room:
                return False
        return True

    def _pieces(self, motion: Motion) -> list[tuple[float, float, float]]:
        """Begin and end of each piece, s, and a bound on how fast points move there, m/s; none leaves its coarse ball."""
        duration = motion.stop_duration
        pieces, begin = [], -motion.period
        while begin < duration:
            _, qd, qdd = motion.proposed(max(begin, 0.0))
            # From a velocity and an acceleration, a stop never gets faster than this.
            fastest = [
                abs(v) + 0.5 * a * a / j for v, a, j in zip(qd, qdd, motion.jerk, strict=True)
            ]
            if begin < 0.0:
                # Nor is the way to the set-point faster than the mean of its ends by more than this.
                gain = 0.5 * motion.period
                fastest = [
                    max(f, 0.5 * (abs(v) + abs(w)) + gain * a)
                    for f, v, w, a in zip(fastest, qd, motion.qd, motion.acceleration, strict=True)
                ]
            share = max(f / v for f, v in zip(fastest, motion.velocity, strict=True))
            speed = sum(r * f for r, f in zip(self._reach, fastest, strict=True))
            end = min(begin + 2.0 * self._time / max(share, 1e-6), duration)
            pieces.append((begin, end, speed))
            begin = end
        return pieces

    def _point_by_point(
        self, motion: Motion, pieces: Sequence[tuple[float, float, float]]
    ) -> Floats | None:
        times = [0.0]  # the set-point itself
        for begin, end, speed in pieces:
            count = max(1, math.ceil(speed * (end - begin) / RESOLUTION))
            times += [begin + (end - begin) * (k + 1) / count for k in range(count)]
        q = _configurations(motion, sorted(times))
        hit = self._checker.check(q)
        first = int(hit.argmax())
        return q[first] if hit[first] else None


def _configurations(motion: Motion, times: Sequence[float]) -> Floats:
    """The configurations of the proposed path at these times (K, J)."""
    return np.array([motion.proposed(time)[0] for time in times])


def free_move(robot: RobotModel, checker: CollisionChecker, begin: Floats, end: Floats) -> bool:
    """Whether the straight joint move between two configurations (J,) is within the limits and free of collisions.

    Every RESOLUTION is checked, as the filter does. From rest the filter moves on such a line to a constant command.
    """
    for q in (begin, end):
        if not ((q >= robot.lower) & (q <= robot.upper)).all():
            return False
    way = end - begin
    count = max(1, math.ceil(float(np.abs(way) @ robot.reach) / RESOLUTION))
    parts = np.linspace(0.0, 1.0, count + 1)[:, None]
    # The ends are most often the reason why a move is not free.
    if checker.check(np.stack([begin, end])).any():
        return False
    return not checker.check(begin + parts * way).any()
