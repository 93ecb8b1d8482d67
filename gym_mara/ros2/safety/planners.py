"""Ruckig's plans, tick by tick: from any state to a target at rest, and from rest on a straight line."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

from gym_mara.errors import GymMaraError
from gym_mara.extras import needs

with needs("the safety filter", "ros2", "ruckig"):
    import ruckig

Numbers = Sequence[float]
"""One number for each joint (J,), as a list of Python: for a few joints its arithmetic is faster than NumPy's."""
State = tuple[list[float], list[float], list[float]]
"""Position, velocity and acceleration, each (J,)."""


class NoTrajectoryError(GymMaraError):
    """Ruckig finds no trajectory to a target."""


class Planner(ABC):
    """Plans one tick ahead. The numbers of joints, limits and states are those of the subclass.

    Args:
        velocity, acceleration, jerk: the limits.
        period: the time of a tick, s.
    """

    def __init__(
        self, velocity: Numbers, acceleration: Numbers, jerk: Numbers, period: float
    ) -> None:
        self._ruckig = ruckig.Ruckig(len(velocity), period)
        self._input = ruckig.InputParameter(len(velocity))
        self._output = ruckig.OutputParameter(len(velocity))
        self._share = 1.0
        self._limit(velocity, acceleration, jerk)

    finished: bool = False
    """Whether the target is reached after the tick."""

    @abstractmethod
    def plan(self, state: State, target: Numbers, share: float) -> State:
        """The state after the next tick, from a state towards a target; the velocity limit is a share of the full one.

        Raises:
            NoTrajectoryError: there is none.
        """

    @abstractmethod
    def before(self, time: float) -> State:
        """The planned state before the end of the tick, by this time, s, of at most a period."""

    def forget(self) -> None:
        """Plan anew, also where the next input is the last one: Ruckig would go on with its trajectory."""
        self._ruckig.reset()

    def _limit(self, velocity: Numbers, acceleration: Numbers, jerk: Numbers) -> None:
        self._velocity = list(velocity)
        self._input.max_velocity = [self._share * v for v in velocity]
        self._input.max_acceleration, self._input.max_jerk = list(acceleration), list(jerk)

    def _update(self, state: State, target: list[float], share: float) -> State:
        given, output = self._input, self._output
        if share != self._share:
            self._share = share
            given.max_velocity = [share * v for v in self._velocity]
        given.current_position, given.current_velocity, given.current_acceleration = state
        given.target_position = target
        self.finished = _checked(self._ruckig.update, given, output) == ruckig.Result.Finished
        return output.new_position, output.new_velocity, output.new_acceleration

    def _at(self, time: float) -> State:
        output = self._output
        return output.trajectory.at_time(max(output.time - time, 0.0))  # type: ignore[no-any-return]


class JointPlanner(Planner):
    """Plans for all joints, from any state; they reach the target together."""

    def plan(self, state: State, target: Numbers, share: float) -> State:
        """As in `Planner`."""
        return self._update(state, list(target), share)

    def before(self, time: float) -> State:
        """As in `Planner`."""
        return self._at(time)


class LinePlanner(Planner):
    """Plans on the straight line from where the joints rest to a target: only how far they are on it.

    A plan for all joints leaves the line when it is made anew on the way, as for another velocity limit.

    Args:
        velocity, acceleration, jerk: the limits of the joints (J,).
        period: the time of a tick, s.
    """

    def __init__(
        self, velocity: Numbers, acceleration: Numbers, jerk: Numbers, period: float
    ) -> None:
        super().__init__([1.0], [1.0], [1.0], period)
        self._joints = velocity, acceleration, jerk
        self.target: list[float] | None = None

    def begin(self, q: Numbers, target: Numbers) -> None:
        """Lay the line from q to another target, each (J,)."""
        self.target, self._start = list(target), list(q)
        way = [b - a for a, b in zip(q, target, strict=True)]
        self._length = max(map(abs, way))
        self._direction = [x / self._length for x in way]
        limits = (
            [min(v / abs(u) for v, u in zip(limit, self._direction, strict=True) if u)]
            for limit in self._joints
        )
        self._limit(*limits)
        self._here: State = [0.0], [0.0], [0.0]
        self.forget()

    def plan(self, state: State, target: Numbers, share: float) -> State:
        """As in `Planner`; the state is that of the last tick, and the target that of the line."""
        self._next = self._update(self._here, [self._length], share)
        return self._placed(self._next)

    def before(self, time: float) -> State:
        """As in `Planner`."""
        return self._placed(self._at(time))

    def advance(self) -> None:
        """Make the planned state the current one."""
        self._here = self._next

    def _placed(self, state: State) -> State:
        """The joints' state, of one on the line."""
        (s,), (v,), (a,) = state
        q = [p + s * u for p, u in zip(self._start, self._direction, strict=True)]
        return q, [v * u for u in self._direction], [a * u for u in self._direction]


class StopPlanner:
    """Plans the fastest stop, of each joint for itself.

    Args:
        velocity, acceleration, jerk: the limits (J,). The velocity is not limited: where a stop begins it already is.
    """

    def __init__(self, velocity: Numbers, acceleration: Numbers, jerk: Numbers) -> None:
        self._ruckig = ruckig.Ruckig(len(velocity))
        self._input = given = ruckig.InputParameter(len(velocity))
        given.control_interface = ruckig.ControlInterface.Velocity
        given.synchronization = ruckig.Synchronization.No
        given.max_velocity = list(velocity)
        given.max_acceleration, given.max_jerk = list(acceleration), list(jerk)

    def trajectory(self) -> Any:
        """An empty trajectory, for `plan`."""
        return ruckig.Trajectory(self._ruckig.degrees_of_freedom)

    def plan(self, state: State, trajectory: Any) -> None:
        """Write the stop from a state into a trajectory.

        Raises:
            NoTrajectoryError: there is none.
        """
        given = self._input
        given.current_position, given.current_velocity, given.current_acceleration = state
        _checked(self._ruckig.calculate, given, trajectory)


def _checked(plan: Any, given: Any, found: Any) -> Any:
    """The result of a call of Ruckig's."""
    try:
        result = plan(given, found)
    except ruckig.RuckigError as error:
        raise NoTrajectoryError(f"Ruckig finds no trajectory: {error}") from None
    if result < 0:
        raise NoTrajectoryError(f"Ruckig finds no trajectory: {result.name}")
    return result
