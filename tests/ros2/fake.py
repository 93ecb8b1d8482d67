"""An arm without ROS, and a clock that tests move: the arm follows its set-points, and a driver ticks as the time passes."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np

from gym_mara.backends.ros2 import Ros2Backend
from gym_mara.ros2.arm import ArmState, Clock, Link, Setpoint
from gym_mara.ros2.driver import Driver
from gym_mara.types import Floats


class FakeClock:
    """Time passes only in `sleep_until`, in ticks of a driver."""

    def __init__(self, driver: Callable[[], Driver]) -> None:
        self.time = self._last = 100.0
        self._driver = driver

    def now(self) -> float:
        return self.time

    def sleep_until(self, instant: float) -> None:
        driver = self._driver()
        while (due := self._last + driver.safety.period) <= instant + 1e-9:
            self.time, self._last = max(self.time, due), due
            driver.tick()
        self.time = max(self.time, instant)

    def pass_by(self, seconds: float) -> None:
        """Let time pass while nobody acts."""
        self.sleep_until(self.time + seconds)


class FakeArm:
    """Reports what it was told a tick ago, for as long as it works."""

    def __init__(self, clock: FakeClock, q: Floats) -> None:
        self.clock = clock
        self.q, self.qd = np.array(q), np.zeros_like(q)
        self.sent: list[Setpoint] = []
        self.follows = True
        self.silent_since: float | None = None
        self.refused: Counter[str] = Counter()
        self.closed = False

    @property
    def state(self) -> ArmState | None:
        received = self.clock.now() if self.silent_since is None else self.silent_since
        return ArmState(self.q.copy(), self.qd.copy(), None, received, received)

    def send(self, setpoint: Setpoint, period: float) -> None:
        assert not self.closed
        self.sent.append(setpoint)
        if self.follows:
            self.q, self.qd = setpoint.q.copy(), setpoint.qd.copy()

    def close(self) -> None:
        self.closed = True


class LateArm(FakeArm):
    """Follows its set-points with the lag of a servo, 0.1 s, and reports where it was two periods ago."""

    def __init__(self, clock: FakeClock, q: Floats) -> None:
        super().__init__(clock, q)
        self._reports = deque([(self.q, self.qd)], maxlen=3)

    @property
    def state(self) -> ArmState | None:
        q, qd = self._reports[0]
        return ArmState(q.copy(), qd.copy(), None, self.clock.now(), self.clock.now())

    def send(self, setpoint: Setpoint, period: float) -> None:
        step = (1.0 - np.exp(-10.0 * period)) * (setpoint.q - self.q)
        self.q, self.qd = self.q + step, step / period
        self._reports.append((self.q, self.qd))


class FakeRos2Backend(Ros2Backend):
    """The backend with an arm and a clock of its own."""

    _in_thread: ClassVar[bool] = False
    start_q: ClassVar[Floats | None] = None
    arm_class: ClassVar[type[FakeArm]] = FakeArm
    clock: FakeClock  # type: ignore[assignment]
    arm: FakeArm

    def _connect(self, profile: str, **options: Any) -> tuple[Link, Clock]:
        self.clock = FakeClock(lambda: self.driver)
        q = self.robot.home if self.start_q is None else self.start_q
        self.arm = self.arm_class(self.clock, q)
        return self.arm, self.clock
