"""Streams set-points to an arm at a fixed rate: reads its state, asks the safety filter, and sends what that allows."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.ros2.arm import ArmState, Clock, Link, Setpoint
from gym_mara.ros2.safety.filter import Mode, SafetyFilter
from gym_mara.types import Floats

_WINDOW = 1000
"""Over how many of the last ticks `Driver.timing` is measured."""
_CLOSING = 3.0
"""How long `close` waits until the arm has stopped, s."""


class ArmStoppedError(GymMaraError):
    """The safety filter has stopped the arm, and it moves again only after `resume`."""


class Timing(NamedTuple):
    """How punctual the last ticks were."""

    ticks: int
    """All of them, from the start on."""
    missed: int
    """How many ticks were left out because the one before them ended too late."""
    lateness: tuple[float, float, float]
    """How much later than planned the last ticks began, s: the median, the 99th percentile and the largest."""


class Driver:
    """Moves one arm. A thread ticks: it passes the last command through the safety filter and sends the set-point.

    Args:
        link: the connection to the arm.
        safety: the filter; its period is that of the ticks.
        clock: sets the pace.
        live: whether set-points are sent. Without it the filter runs as if the arm followed exactly, and nothing is sent.
        on_setpoint: is called with each set-point.
    """

    def __init__(
        self,
        link: Link,
        safety: SafetyFilter,
        clock: Clock,
        *,
        live: bool,
        on_setpoint: Callable[[Setpoint], None] | None = None,
    ) -> None:
        self.link, self.safety, self.live = link, safety, live
        self._clock, self._on_setpoint = clock, on_setpoint
        self._lock = threading.RLock()
        self._command: Floats | None = None
        self._commanded = 0.0
        self._setpoint: Setpoint | None = None
        self._thread: threading.Thread | None = None
        self._ending = False
        self._failure: Exception | None = None
        self._ticks = self._missed = 0
        self._late: deque[float] = deque(maxlen=_WINDOW)

    def start(self, *, thread: bool = True) -> None:
        """Start at the measured pose.

        Args:
            thread: whether a thread ticks; otherwise the caller calls `tick`.

        Raises:
            GymMaraError: there is no state of the arm, or the filter cannot start there.
        """
        with self._lock:
            self.safety.start(self._reported(), self._clock.now())
            self._hold()
        if thread and self._thread is None:
            self._thread = threading.Thread(target=self._run, name="gym_mara driver", daemon=True)
            self._thread.start()

    def _reported(self) -> ArmState:
        if (state := self.link.state) is None:
            raise GymMaraError("the arm has not reported its state yet")
        return state

    def _hold(self) -> None:
        """Command the arm to stay where the filter starts it."""
        self._command, self._commanded = None, self._clock.now()

    def command(self, q_target: Floats) -> None:
        """Move towards joint targets (J,), rad (m), from the next tick on.

        Raises:
            ArmStoppedError: the arm is stopped.
            GymMaraError: the driver itself has failed.
        """
        with self._lock:
            self.check()
            self._command, self._commanded = np.array(q_target), self._clock.now()

    def check(self) -> None:
        """Check that the arm can be moved.

        Raises:
            ArmStoppedError: it is stopped.
            GymMaraError: the driver itself has failed.
        """
        if self._failure is not None:
            raise GymMaraError(
                f"the arm is no longer driven: {type(self._failure).__name__}: {self._failure}"
            ) from self._failure
        if self.safety.mode in (Mode.STOPPING, Mode.STOPPED):
            raise ArmStoppedError(
                f"the arm has stopped: {self.safety.reason}; when it is safe, resume it with the service /gym_mara/resume or "
                "Driver.resume"
            )

    def stop(self, reason: str) -> None:
        """Decelerate to a hold, and stay there until `resume`."""
        with self._lock:
            self.safety.stop(reason)

    def resume(self) -> None:
        """Move again, from where the arm is.

        Raises:
            GymMaraError: the filter cannot start there, or the driver itself has failed.
        """
        with self._lock:
            if self._failure is not None:
                self.check()
            self.safety.resume(self._reported(), self._clock.now())
            self._hold()

    @property
    def setpoint(self) -> Setpoint | None:
        """The last set-point; None before the first tick."""
        return self._setpoint

    @property
    def timing(self) -> Timing:
        """How punctual the last ticks were."""
        late = np.array(self._late or [0.0])
        figures = float(np.median(late)), float(np.quantile(late, 0.99)), float(late.max())
        return Timing(self._ticks, self._missed, figures)

    def tick(self) -> Setpoint:
        """Pass the last command through the filter, and send the set-point."""
        now = self._clock.now()
        with self._lock:
            state = self.link.state
            if not self.live and state is not None and self._setpoint is not None:
                # Nothing moves, so that the filter sees an arm that follows.
                state = state._replace(q=self._setpoint.q, qd=self._setpoint.qd)
            setpoint = self.safety.step(now, state, self._command, self._commanded)
            self._setpoint = setpoint
            self._ticks += 1
        if self.live:
            self.link.send(setpoint, self.safety.period)
        if self._on_setpoint is not None:
            self._on_setpoint(setpoint)
        return setpoint

    def _run(self) -> None:
        period = self.safety.period
        due = self._clock.now()
        try:
            while not self._ending:
                self._late.append(max(0.0, self._clock.now() - due))
                self.tick()
                due += period
                behind = self._clock.now() - due
                if behind > period:
                    self._missed += (left_out := int(behind / period))
                    due += left_out * period
                self._clock.sleep_until(due)
        except Exception as error:  # whatever it is, whoever commands the arm must learn of it
            self._failure = error

    def close(self) -> None:
        """Decelerate to a hold, and end. A second call has no effect."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self.stop("the connection is closed")
            end = self._clock.now() + _CLOSING
            while (
                self.safety.mode is Mode.STOPPING
                and self._failure is None
                and self._clock.now() < end
            ):
                self._clock.sleep_until(self._clock.now() + self.safety.period)
            self._ending = True
            thread.join(_CLOSING)
        self.link.close()
