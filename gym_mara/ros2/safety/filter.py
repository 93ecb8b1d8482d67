"""The safety filter: every command to an arm passes it, and only set-points that can still stop leave it.

It works in software, on what the arm reports and on a model of the arm and its surroundings. It replaces no emergency stop, no
protective stop of the arm's controller and no risk assessment. It sees no person and no object that the robot's model does not have.
"""

from __future__ import annotations

import math
import threading
from enum import Enum
from typing import Any

import numpy as np

from gym_mara.collision.base import CollisionChecker
from gym_mara.errors import GymMaraError, positive_number
from gym_mara.robot import RobotModel
from gym_mara.ros2.arm import ArmState, Setpoint
from gym_mara.ros2.safety.motion import Motion, MotionLimits
from gym_mara.ros2.safety.paths import PathChecker
from gym_mara.ros2.safety.watchdogs import Guard, Watchdogs, too_old, wrong_clock
from gym_mara.types import Floats

__all__ = ["NO_EMERGENCY_STOP", "Mode", "SafetyFilter", "Watchdogs"]

NO_EMERGENCY_STOP = "the safety filter replaces no emergency stop: keep one within reach, and nobody within the arm's reach"
"""What a program says before it moves an arm."""
RAMP_TIME = 1.0
"""After a start or a resume, the velocity limit rises to all of it in this time of motion, s."""
RAMP_START = 0.1
"""The share of the velocity limit with which a motion begins."""
LOWEST_SPEED = 0.01
"""The smallest share of the velocity limits that can be set."""
OVERSHOOT = 1e-3
"""A joint at its end stop may be measured so far beyond its limit, rad (m)."""


class Mode(str, Enum):
    """What the filter does."""

    WAITING = "waiting"
    """It has not started, or it sends nothing until the first command: the arm may be moved by others."""
    MOVING = "moving"
    """It follows the commands, and holds the arm where they are reached."""
    STOPPING = "stopping"
    """It decelerates the arm, and takes no command."""
    STOPPED = "stopped"
    """It holds the arm, and takes no command until an operator resumes."""


class SafetyFilter:
    """Makes set-points of commands, one each tick, that are safe by themselves: whatever follows, the arm can stop.

    From each set-point a stop that keeps the limits of acceleration and jerk is known. It stays within the joint limits, and neither
    it nor the way to the set-point collides. A set-point without one is refused: the arm follows the last stop, and the stop is
    latched. What stops the arm as well: a command that is no J finite numbers, or too old while the arm moves; a state that is too old;
    an arm that does not follow its set-points; a pause between ticks while it moves; a clock that does not advance. A target beyond the
    joint limits is cut to them. Commands take effect only after `start`; after a stop only after `resume`. The first one moves the arm
    from where it is measured then, and only if it could start there.

    It replaces no emergency stop. Its methods may be called from any thread.

    Args:
        robot: the arm.
        period: the time between two ticks, s.
        limits: of the motion.
        watchdogs: what else stops the arm, and how still it must be to start.
        checker: finds collisions; None for no such checks.

    Raises:
        GymMaraError: a setting is out of its range, or does not fit the robot.
    """

    def __init__(
        self,
        robot: RobotModel,
        period: float,
        limits: MotionLimits,
        watchdogs: Watchdogs = Watchdogs(),  # noqa: B008 - it is frozen
        checker: CollisionChecker | None = None,
    ) -> None:
        self.robot, self.watchdogs = robot, watchdogs
        self._guard = Guard(robot.joint_names, watchdogs)
        self.period = positive_number(
            "period",
            period,
            "s",
            at_least=1e-4,
            at_most=1.0,
            reason="no arm is streamed to at others",
        )
        if len(limits.velocity) != robot.num_joints:
            raise GymMaraError(
                f"the motion limits are of {len(limits.velocity)} joints, and {robot.name} has {robot.num_joints}: make "
                "them with MotionLimits.of(robot)"
            )
        self.mode, self.reason, self.blocked = Mode.WAITING, None, False
        self.clipped = 0
        self._speed = 1.0
        self.longest_stop = float(
            (limits.velocity / limits.acceleration + 2.0 * limits.acceleration / limits.jerk).max()
        )
        """An upper bound of the time that a stop takes, s."""
        self._motion = Motion(limits, robot.lower, robot.upper, self.period)
        self._paths = None if checker is None else PathChecker(robot, checker, limits.velocity)
        self._started = False
        self._moved = 0.0  # for how long since the start or resume, s
        self._now = self._begun = self._commanded = -math.inf
        self._lock = threading.RLock()

    mode: Mode
    """What it does."""
    reason: str | None
    """Why it stops or stopped; None while it does not."""
    blocked: bool
    """Whether it stops or stopped because of a collision ahead alone: nothing is wrong with the arm then."""
    clipped: int
    """How many commands were cut to the joint limits."""

    @property
    def setpoint(self) -> Setpoint | None:
        """The set-point of the last tick; None before the start."""
        with self._lock:
            return self._current() if self._started else None

    @property
    def speed(self) -> float:
        """The velocity limit as a share of the full one, from LOWEST_SPEED to 1. A faster arm brakes when it is lowered."""
        return self._speed

    @speed.setter
    def speed(self, share: float) -> None:
        self._speed = positive_number(
            "speed", share, at_least=LOWEST_SPEED, at_most=1.0, reason="it is a share of the limits"
        )

    def start(self, state: ArmState | None, now: float) -> None:
        """Begin at the measured pose, with a ramp.

        Args:
            state: what the arm reports.
            now: the time, s.

        Raises:
            GymMaraError: the filter has started before, or it cannot start there: there is no fresh state, the arm moves, is
                beyond its joint limits or collides. Nothing has changed then.
        """
        with self._lock:
            if self.mode is Mode.STOPPED:
                raise GymMaraError(f"the arm is stopped ({self.reason}): an operator must resume")
            if self._started:
                raise GymMaraError("the safety filter has started already")
            self._begin(state, now)

    def resume(self, state: ArmState | None, now: float) -> None:
        """End a stop, at the wish of an operator: go on from the measured pose, with a ramp.

        Args:
            state: what the arm reports.
            now: the time, s.

        Raises:
            GymMaraError: the arm is not stopped, or the filter cannot start there (see `start`). Nothing has changed then.
        """
        with self._lock:
            if self.mode is Mode.STOPPING:
                raise GymMaraError("the arm still decelerates: resume it when it rests")
            if self.mode is not Mode.STOPPED:
                raise GymMaraError(f"there is no stop to resume from: the arm is {self.mode.value}")
            self._begin(state, now)

    def stop(self, reason: str) -> None:
        """Begin to decelerate the arm to a hold, which lasts until an operator resumes; return at once.

        The first of several reasons stays, but for a collision ahead, which says less than what comes after it.
        """
        with self._lock:
            if self.mode in (Mode.WAITING, Mode.MOVING):
                self.mode, self.reason = Mode.STOPPING, reason
                if not self._started:  # nothing moves, but a start is refused from now on
                    self.mode = Mode.STOPPED
            elif self.blocked:
                self.reason, self.blocked = reason, False

    def step(
        self, now: float, state: ArmState | None, command: Floats | None, commanded: float
    ) -> Setpoint:
        """The set-point of the next tick. Its arrays are fresh.

        Args:
            now: the time, s, later than at the last tick.
            state: what the arm reports; None if it reports nothing.
            command: joint targets (J,), rad (m). None while there is none yet, and the arm holds; later None is a missing one,
                and stops it. What was commanded before the start or the resume counts as none.
            commanded: the time of the command, s.

        Raises:
            GymMaraError: the filter has not started. Whatever is wrong with the arguments stops the arm, and raises nothing.
        """
        with self._lock:
            if not self._started:
                raise GymMaraError(
                    "the safety filter has not started: call start with a measured state"
                )
            if self.mode is not Mode.STOPPED:
                self._tick(now, state, command, commanded)
            return self._current()

    def _current(self) -> Setpoint:
        motion = self._motion
        return Setpoint(np.array(motion.q), np.array(motion.qd), np.array(motion.qdd))

    def _tick(self, now: float, state: Any, command: Any, commanded: float) -> None:
        before, self._now = self._now, now
        if self.mode is not Mode.STOPPING:
            try:
                trouble = wrong_clock(before, now)
                if self.mode is Mode.MOVING or not (command is None or commanded < self._begun):
                    trouble = trouble or self._wrong_state(now, state)
                    trouble = trouble or self._pause(before, now)
                    trouble = trouble or self._follow(now, command, commanded)
            except Exception as error:  # whatever fails, in an engine too, the arm has to stop
                trouble = f"the safety filter failed: {error!r}"
            if trouble is not None:
                self.stop(trouble)
        if self.mode is Mode.STOPPING and self._motion.follow_stop():
            self.mode = Mode.STOPPED

    def _wrong_state(self, now: float, state: Any) -> str | None:
        """What is wrong with the arm's state. Before the first command it may have been moved: the set-point goes to where it is."""
        trouble = self._guard.wrong_state(now, state, self._motion.q)
        if trouble is None and self.mode is Mode.WAITING:
            try:
                self._rest_at(state, now)
            except GymMaraError as error:
                return str(error)
        return trouble

    def _pause(self, before: float, now: float) -> str | None:
        """What is wrong with the time since the last tick: without set-points the arm's controller has stopped it."""
        if self._motion.resting or now - before <= self.watchdogs.state_age:
            return None
        return f"no set-point was sent for {now - before:.3g} s, and the arm moved"

    def _follow(self, now: float, command: Any, commanded: float) -> str | None:
        """Move the set-point towards a command; returns why not."""
        if command is None:
            return "the commands have ended"
        asked = self._guard.numbers(command)
        if isinstance(asked, str):
            return f"the command {asked}"
        motion = self._motion
        target = motion.clip(asked)
        arrived = motion.resting and target == motion.q
        trouble = too_old("the command", now, commanded, self.watchdogs.command_age)
        if trouble and not arrived:
            return trouble
        if target != asked and commanded != self._commanded:
            self.clipped += 1
        self._commanded, self.mode = commanded, Mode.MOVING
        if arrived:
            return None
        ramp = RAMP_START + (1.0 - RAMP_START) * self._moved / RAMP_TIME
        if not motion.propose(target, min(self._speed, ramp, 1.0)):
            return "a stop from the next set-point would leave the joint limits"
        if self._paths is not None:
            collision = self._paths.first_collision(motion)
            if collision is not None:
                self.blocked = True
                return "collision ahead" + self._touching(collision)
        motion.accept()
        self._moved += self.period
        return None

    def _begin(self, state: Any, now: float) -> None:
        if state is None:
            raise GymMaraError("the arm reports no state, and moves only from a measured pose")
        self._rest_at(state, now)
        self.mode, self.reason, self.blocked = Mode.WAITING, None, False
        self._started = True
        self._moved, self._now, self._begun = 0.0, now, now

    def _rest_at(self, state: Any, now: float) -> None:
        """Put the set-point at rest at the measured pose.

        Raises:
            GymMaraError: the arm cannot start there, and nothing has changed.
        """
        self._guard.check_rest(now, state)
        measured = self._guard.numbers(state.q)
        if not isinstance(measured, str):
            within = self._motion.clip(measured)
            if all(abs(a - b) <= OVERSHOOT for a, b in zip(within, measured, strict=True)):
                measured = within
        q = state.q if isinstance(measured, str) else measured
        q = self.robot.checked_q(q, "the measured pose")
        if self._paths is not None and self._paths.collides(q):
            raise GymMaraError(
                f"the arm collides at its measured pose{self._touching(q)}: move it by hand or with its own controller, or "
                "correct the robot's model"
            )
        self._motion.rest_at(q.tolist())

    def _touching(self, q: Floats) -> str:
        """The links that touch at q (J,), for a reason; Coal may see no contact where another engine does."""
        from gym_mara.collision.coal import touching_links

        links = sorted(touching_links(self.robot, q))
        return f": {', '.join(links[:-1])} and {links[-1]}" if len(links) > 1 else ""
