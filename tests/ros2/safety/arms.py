"""An arm that follows a safety filter exactly, for its tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from gym_mara.collision import CollisionChecker
from gym_mara.robot import RobotModel
from gym_mara.ros2.arm import ArmState, Setpoint
from gym_mara.ros2.safety.filter import Mode, SafetyFilter, Watchdogs
from gym_mara.ros2.safety.motion import MotionLimits
from tests.helpers import Floats

PERIOD = 0.01
LONGEST_STOP = 0.5
"""With the default limits every arm rests after less than this, s."""


def state_of(q: Floats, received: float, qd: Floats | float = 0.0) -> ArmState:
    """A state as an arm reports it."""
    return ArmState(q.copy(), np.broadcast_to(qd, q.shape).copy(), None, received, 0.0)


class Arm:
    """A filter and an arm that follows it exactly."""

    def __init__(
        self,
        robot: RobotModel,
        checker: CollisionChecker | None = None,
        watchdogs: Watchdogs | None = None,
        q: Floats | None = None,
    ) -> None:
        self.robot, self.now = robot, 10.0
        self.filter = SafetyFilter(
            robot, PERIOD, MotionLimits.of(robot), watchdogs or Watchdogs(), checker
        )
        self.q = robot.home if q is None else q
        self.filter.start(state_of(self.q, self.now), self.now)

    def tick(self, command: Any, **changes: Any) -> Setpoint:
        """A tick, with other arguments of `step` where they are given."""
        self.now += PERIOD
        fresh = {"now": self.now, "state": state_of(self.q, self.now), "commanded": self.now}
        setpoint = self.filter.step(command=command, **{**fresh, **changes})
        self.q = setpoint.q
        return setpoint

    def ticks(self, command: Any, count: int, **changes: Any) -> list[Setpoint]:
        """Several of them."""
        return [self.tick(command, **changes) for _ in range(count)]

    def until_stopped(self, command: Any = None) -> list[Setpoint]:
        """The set-points until the arm has stopped."""
        setpoints = []
        while self.filter.mode is not Mode.STOPPED:
            setpoints.append(self.tick(command))
            assert len(setpoints) * PERIOD < LONGEST_STOP
        return setpoints

    def is_in(self, mode: Mode) -> None:
        """Check the mode, and that there is a reason if it is a stop."""
        assert self.filter.mode is mode
        assert bool(self.filter.reason) == (mode in (Mode.STOPPING, Mode.STOPPED))

    def resume(self) -> None:
        """Resume where the arm is."""
        self.filter.resume(state_of(self.q, self.now), self.now)


def in_motion(robot: RobotModel, **arguments: Any) -> Arm:
    """An arm at full speed."""
    arm = Arm(robot, **arguments)
    arm.ticks(robot.home + 1.5, 130)
    assert np.abs(arm.filter.setpoint.qd).max() > 0.5  # type: ignore[union-attr]
    return arm
