"""Joint states that arrive by name, in any order, as states of a robot; what is not complete and finite is refused."""

from __future__ import annotations

import difflib
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from gym_mara.errors import LARGEST
from gym_mara.robot import RobotModel
from gym_mara.ros2.arm import ArmState
from gym_mara.types import Floats

LIMIT_MARGIN = (0.1, 0.01)
"""How far a joint may be beyond its limits in a state, rad, and m for a prismatic joint. An arm may rest a little beyond the
limits of its URDF; farther away the numbers have another unit or another zero."""
CLOCK_SET_BACK = 1.0
"""A stamp that is older than the last one by more than this, s, is that of a clock that was set back, such as a simulation's."""
SHORTEST_DIFFERENCE = 0.005
"""The shortest time over which velocities are computed from positions, s: over less, the jitter of the times counts too much."""

LATE = 0.25
"""A state is late that took so much longer on its way than the fastest of the last seconds, s. What it says is over."""
LATE_WINDOW = 5.0
"""Over how long the fastest is looked for, s: the clocks of sender and receiver need not agree, and may drift apart."""

DUPLICATES = "duplicate joints"
LENGTHS = "lengths that do not fit"
UNKNOWN = "unknown joints"
MISSING = "missing joints"
NOT_FINITE = "not finite"
BEYOND_LIMITS = "beyond the limits"
OUT_OF_ORDER = "out of order"
REPEATED = "repeated stamp"
TOO_LATE = "too late"
REASONS = (
    *(DUPLICATES, LENGTHS, UNKNOWN, MISSING, NOT_FINITE, BEYOND_LIMITS),
    *(OUT_OF_ORDER, REPEATED, TOO_LATE),
)
"""Why a state is refused."""


class _RefusedError(Exception):
    """A state is refused: the reason, one of REASONS, and the details."""


class JointMap:
    """Turns joint states by name into states in the robot's order. It is for the states of one arm, in the order of their arrival.

    Joints that the robot does not have, such as those of a gripper, are ignored. Names must be equal: a prefix makes another name.

    Where a state has no velocities (none, or NaN for every joint), they are the differences of positions, over the stamps
    or, without stamps, over the times of arrival, and over at least SHORTEST_DIFFERENCE; zero in the first state. Efforts
    that are all NaN count as none. A stamp of 0 is none. With stamps, states that arrive late are found too, see LATE.

    Args:
        robot: the arm.
    """

    def __init__(self, robot: RobotModel) -> None:
        self.joint_names = robot.joint_names
        self.refused: Counter[str] = Counter()
        """How many states were refused, by reason."""
        self.last_refusal: str | None = None
        """The reason of the last refusal, with the details."""
        margin = np.where(robot.kinematics().prismatic, LIMIT_MARGIN[1], LIMIT_MARGIN[0])
        self._lower, self._upper = robot.lower - margin, robot.upper + margin
        self._limits = robot.lower, robot.upper
        self._names: list[str] | None = None
        self._order: NDArray[np.intp] = np.zeros(0, np.intp)
        self._stamp = 0.0
        self._ways: list[tuple[float, float]] = []
        self._anchor: tuple[Floats, float, bool] | None = None
        self._velocity = np.zeros(robot.num_joints)

    def read(
        self,
        names: Sequence[str],
        position: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
        *,
        received: float,
        stamp: float = 0.0,
    ) -> ArmState | None:
        """A state in the robot's order; None if it is refused, which `refused` and `last_refusal` tell.

        Args:
            names: of the joints (K,).
            position: rad (m), (K,).
            velocity: rad/s (m/s), (K,), or empty.
            effort: Nm (N), (K,), or empty.
            received: when it arrived, s.
            stamp: the time of its header, s; 0 for none.
        """
        try:
            return self._read(names, position, velocity, effort, received, stamp)
        except _RefusedError as refusal:
            reason, details = refusal.args
            self.refuse(reason, details)
            return None

    def refuse(self, reason: str, details: str) -> None:
        """Count a refusal; for messages that cannot be read at all, too."""
        self.refused[reason] += 1
        self.last_refusal = f"{reason}: {details}"

    def _read(
        self,
        names: Sequence[str],
        position: Sequence[float],
        velocity: Sequence[float],
        effort: Sequence[float],
        received: float,
        stamp: float,
    ) -> ArmState:
        if names != self._names:
            self._order = self._indices(list(names))
            self._names = list(names)
        q = self._values("position", position)
        if q is None:
            raise _RefusedError(LENGTHS, f"{len(names)} names and no positions")
        qd, torque = self._values("velocity", velocity), self._values("effort", effort)
        beyond = (q < self._lower) | (q > self._upper)
        if beyond.any():
            joint = int(beyond.argmax())
            low, high = (limit[joint] for limit in self._limits)
            raise _RefusedError(
                BEYOND_LIMITS,
                f"{self.joint_names[joint]} is at {q[joint]:.6g}, and its limits are [{low:.6g}, {high:.6g}]: has it the unit rad "
                "(m), and the zero of the URDF?",
            )
        if stamp != 0.0:
            self._check_stamp(stamp)
            self._check_way(received, stamp)
        own = self._difference(q, received, stamp)
        return ArmState(q, own if qd is None else qd, torque, received, stamp)

    def _indices(self, names: list[str]) -> NDArray[np.intp]:
        """Where each of the robot's joints is in the names."""
        places = {name: index for index, name in enumerate(names)}
        missing = [name for name in self.joint_names if name not in places]
        if len(missing) == len(self.joint_names):
            raise _RefusedError(UNKNOWN, self.advice(names))
        if missing:
            raise _RefusedError(MISSING, f"{', '.join(missing)} of the robot's joints")
        twice = [name for name in self.joint_names if names.count(name) > 1]
        if twice:
            raise _RefusedError(DUPLICATES, f"{', '.join(twice)} more than once")
        return np.array([places[name] for name in self.joint_names])

    def _values(self, what: str, values: Sequence[float]) -> Floats | None:
        """The values of the robot's joints; None where there are none."""
        if len(values) == 0:
            return None
        if len(values) != (count := len(self._names or ())):
            raise _RefusedError(LENGTHS, f"{count} names and {len(values)} values of {what}")
        own = np.asarray(values, np.float64)[self._order]
        if bool((np.abs(own) <= LARGEST).all()):
            return own
        if what != "position" and bool(np.isnan(own).all()):
            return None  # ros2_control's joint_state_broadcaster fills what a joint does not report with NaN
        joint = int((~(np.abs(own) <= LARGEST)).argmax())
        raise _RefusedError(
            NOT_FINITE, f"the {what} of {self.joint_names[joint]} is {own[joint]:.6g}"
        )

    def _check_stamp(self, stamp: float) -> None:
        last = self._stamp
        if not math.isfinite(stamp) or stamp < 0.0:
            raise _RefusedError(OUT_OF_ORDER, f"its stamp is {stamp:.6g} s")
        if last == stamp:
            raise _RefusedError(
                REPEATED,
                f"it has the stamp of the state before, {stamp:.3f} s: the sender's clock stands still, or it repeats an old state",
            )
        if stamp < last:
            if last - stamp > CLOCK_SET_BACK:  # the next one is measured by the new clock
                self._stamp, self._anchor, self._ways = stamp, None, []
            raise _RefusedError(
                OUT_OF_ORDER,
                f"its stamp is {last - stamp:.3f} s before that of the state before: two senders, or a clock that was set back",
            )
        self._stamp = stamp

    def _check_way(self, received: float, stamp: float) -> None:
        """Compare the time on the way with the fastest one, which stands in the last two halves of the window."""
        way, ways = received - stamp, self._ways
        if not ways or received - ways[-1][0] >= LATE_WINDOW / 2.0:
            self._ways = ways = [*ways[-1:], (received, way)]
        ways[-1] = ways[-1][0], min(ways[-1][1], way)
        late = way - min(fastest for _, fastest in ways)
        if late > LATE:
            raise _RefusedError(
                TOO_LATE,
                f"it took {late:.3f} s longer on its way than others: the network or a machine is too busy, or the sender's clock "
                "does not run in real time",
            )

    def _difference(self, q: Floats, received: float, stamp: float) -> Floats:
        """The velocities from the differences of positions (J,)."""
        stamped = stamp != 0.0
        time = stamp if stamped else received
        if self._anchor is None or self._anchor[2] != stamped:
            self._anchor, self._velocity = (q, time, stamped), np.zeros(len(q))
        elif (elapsed := time - self._anchor[1]) >= SHORTEST_DIFFERENCE:
            self._velocity = (q - self._anchor[0]) / elapsed
            self._anchor = q, time, stamped
        return self._velocity.copy()

    def advice(self, names: Sequence[str]) -> str:
        """What to do about names none of which is a joint of the robot."""
        there = ", ".join(names[:12]) + (", …" if len(names) > 12 else "")
        message = f"none of {there or 'no names'} is one of {', '.join(self.joint_names)}"
        first = self.joint_names[0]
        longer = [name for name in names if name.endswith(first) and name != first]
        prefix = longer[0][: -len(first)] if longer else ""
        if prefix and all(f"{prefix}{name}" in names for name in self.joint_names):
            return f"{message}: all have the prefix {prefix!r}; use a URDF with these names, or start the arm without the prefix"
        similar = difflib.get_close_matches(first, names, n=1)
        hint = f": is {similar[0]!r} meant by {first!r}" if similar else ": is it another robot"
        return f"{message}{hint}?"
