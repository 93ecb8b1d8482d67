"""Streams set-points to an arm at a fixed rate: reads its state, asks the safety filter, and sends what that allows."""

from __future__ import annotations

import atexit
import gc
import threading
from collections import deque
from typing import NamedTuple

import numpy as np

from gym_mara.errors import GymMaraError
from gym_mara.ros2.arm import ArmState, Clock, Link, Setpoint
from gym_mara.ros2.safety.filter import Mode, SafetyFilter
from gym_mara.types import Floats

_WINDOW = 1000
"""Over how many of the last ticks `Driver.timing` is measured."""
_REPEATED = 0.2
"""For how long the last set-point of a stop is sent again, s, because messages can be lost."""
_MARGIN = 1.0
"""How much longer than a stop `close` and `resume_if_blocked` wait for its end, s."""


def spare_what_is_loaded() -> None:
    """Leave all objects that there are now out of garbage collections, until `gc.unfreeze`.

    A full collection of some loaded libraries takes 0.1 s, and an arm without set-points for so long has to stop.
    """
    gc.collect()
    gc.freeze()


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

    Nothing is sent before the first command and after the end of a stop, so that an arm can be moved by hand or by another program
    then.

    Args:
        link: the connection to the arm.
        safety: the filter; its period is that of the ticks.
        clock: sets the pace.
        live: whether set-points are sent. Without it the filter runs as if the arm followed exactly, and nothing is sent.
    """

    def __init__(
        self,
        link: Link,
        safety: SafetyFilter,
        clock: Clock,
        *,
        live: bool,
    ) -> None:
        self.link, self.safety, self.live = link, safety, live
        self._clock = clock
        self._lock = threading.RLock()
        self._command: Floats | None = None
        self._commanded = 0.0
        self._setpoint: Setpoint | None = None
        self._thread: threading.Thread | None = None
        self._ending = False
        self._failure: Exception | None = None
        self._ticks = self._missed = 0
        self._late: deque[float] = deque(maxlen=_WINDOW)
        self._sent_until = -np.inf

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
            spare_what_is_loaded()
            self._thread = threading.Thread(target=self._run, name="gym_mara driver", daemon=True)
            self._thread.start()
            # At the end of a process that does not close it, the arm comes to rest, and what was spared is freed.
            atexit.register(self.close)

    def _reported(self) -> ArmState:
        if (state := self.link.state) is None:
            raise GymMaraError("the arm has not reported its state yet")
        return state

    def _hold(self) -> None:
        """Forget the last command: the arm stays where the filter has started it."""
        self._command, self._commanded, self._setpoint = None, self._clock.now(), None
        self._sent_until = -np.inf

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
                f"the arm has stopped: {self.safety.reason}; when it is safe, an operator has to resume it"
            )

    @property
    def failure(self) -> Exception | None:
        """What has ended the thread; None if nothing has."""
        return self._failure

    def stop(self, reason: str) -> None:
        """Begin to decelerate to a hold, which lasts until `resume`; return at once."""
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

    def resume_if_blocked(self) -> None:
        """Move again after a stop whose only reason is a collision ahead; wait until the arm rests.

        Raises:
            GymMaraError: as in `resume`.
        """
        end = self._clock.now() + self.safety.longest_stop + _MARGIN
        trouble = GymMaraError("the arm has not come to rest in time")
        while self.safety.blocked and self._failure is None:
            with self._lock:
                if self.safety.blocked and self.safety.mode is Mode.STOPPED:
                    try:
                        return self.resume()
                    except GymMaraError as error:  # it may need a moment to rest
                        trouble = error
            if self._clock.now() > end:
                raise trouble
            self._clock.sleep_until(self._clock.now() + self.safety.period)
        return None

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
        """Pass the last command through the safety filter, and send the set-point."""
        with self._lock:
            now = self._clock.now()
            state = self.link.state
            last, begun = self._setpoint, self.safety.mode is not Mode.WAITING
            if not self.live and begun and state is not None and last is not None:
                # Nothing moves, so that the filter sees an arm that follows.
                state = state._replace(q=last.q, qd=last.qd)
            setpoint = self.safety.step(now, state, self._command, self._commanded)
            self._setpoint = setpoint
            self._ticks += 1
            if self.safety.mode in (Mode.MOVING, Mode.STOPPING):
                self._sent_until = now + _REPEATED
            if self.live and now <= self._sent_until and self.safety.mode is not Mode.WAITING:
                self.link.send(setpoint, self.safety.period)
        return setpoint

    def _run(self) -> None:
        period = self.safety.period
        due = self._clock.now()
        try:
            while not (self._ending and self.safety.mode is not Mode.STOPPING):
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
        """Decelerate to a hold, and end. A second call has no effect, or waits again if the first was interrupted."""
        if (thread := self._thread) is not None:
            self.stop("the connection is closed")
            self._ending = True  # the thread ends when the arm has stopped
            thread.join(self.safety.longest_stop + _MARGIN)
            self._thread = None
            atexit.unregister(self.close)
            gc.unfreeze()
        self.link.close()
