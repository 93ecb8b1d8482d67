"""A simulated arm that follows commands as a controller of ros2_control does. Nothing here needs ROS."""

from __future__ import annotations

import threading
from collections.abc import Sequence

import numpy as np

from gym_mara.backends import Backend
from gym_mara.errors import GymMaraError
from gym_mara.ros2.arm import Clock
from gym_mara.ros2.sim.trajectories import Goal, Path, Point, ServoWay, Trajectory, Way, row
from gym_mara.state import SimState
from gym_mara.types import Floats

OLD = 1.0
"""A trajectory that ended longer ago than this, s, is not followed."""
RUNNING, DONE, REPLACED = "running", "done", "replaced"
"""What has become of a trajectory."""


class SimulatedArm:
    """One arm of a backend, and the reference that it follows.

    A command starts at the next tick, from the reference, which is where the arm rests, and the latest one before a tick
    counts. After its end the arm holds. Time is that of the simulation, so that a program that was stopped goes on where it
    was. `tick` belongs to one thread; the other methods may be called from any.

    Args:
        backend: of one arm, on NumPy's arrays, in which joints have limits of velocity.
        seed: of the random parameters, where the backend has some; each reset draws new ones.

    Raises:
        GymMaraError: the backend is another one.
    """

    def __init__(self, backend: Backend, seed: int = 0) -> None:
        if backend.num_envs != 1 or backend.arrays != "numpy":
            raise GymMaraError("a simulated arm needs a backend of one arm with NumPy's arrays")
        if backend.teleports:
            raise GymMaraError(
                "the joints of this backend jump to their targets, as no arm does: give servo_gain=10 or max_joint_velocity"
            )
        self.backend, self.robot = backend, backend.robot
        self.period = backend.control_period
        """The time between two ticks, s."""
        self.ticks = 0
        """How many there were."""
        self._random = np.random.default_rng(seed)
        self._lock = threading.Lock()
        self._pending: tuple[Trajectory | Goal | Floats | None, float] | None = None
        self._path: Way | None = None
        self._number = self._started = 0
        self._resetting: threading.Event | None = None
        self._limits = self.robot.lower, self.robot.upper
        self._put_at_home()

    @property
    def time(self) -> float:
        """The simulated time since the start, s. A reset does not change it."""
        return self.ticks * self.period

    def follow(self, names: Sequence[str], points: Sequence[Point], delay: float = 0.0) -> int:
        """Follow a trajectory; one without points stops the arm where it is. Returns its number, for `outcome`.

        Args:
            names: of the joints, in the order of the points' values.
            points: positions, velocities and times.
            delay: from now to its start, s; negative if it has already started.

        Raises:
            GymMaraError: it is not complete and finite, has other joints, or ended long ago. Nothing changes.
        """
        if not len(points):
            return self._command(None, 0.0)
        trajectory = Trajectory.of(self.robot.joint_names, names, points)
        if trajectory.times[-1] + delay < -OLD:
            raise GymMaraError(
                f"a trajectory ended {-trajectory.times[-1] - delay:.3f} s ago: the stamp in its header must be zero or of now, "
                "on the clock of this arm"
            )
        return self._command(trajectory, delay)

    def move_to(self, positions: Sequence[float]) -> int:
        """Take joint positions (J,), rad (m), as targets at once. Returns the command's number.

        Raises:
            GymMaraError: they are not J finite numbers. Nothing changes.
        """
        return self._command(row(positions, self.robot.num_joints, "position"), 0.0)

    def move_servos(self, names: Sequence[str], points: Sequence[Point]) -> int:
        """Move each joint by itself to its position in the first point, at its velocity there, as the real MARA of 2019 did. The time
        of the point and other points have no effect; without a point the arm stops where it is. Returns the command's number.

        Args:
            names: of the joints, in the order of the points' values.
            points: positions and velocities.

        Raises:
            GymMaraError: the first point is not complete and finite, has no velocities, or has other joints. Nothing changes.
        """
        return self._command(
            Goal.of(self.robot.joint_names, names, points) if len(points) else None, 0.0
        )

    def reset(self) -> threading.Event:
        """Put the arm at rest at its home pose with the next tick, and forget all commands. The event is set when that is done."""
        with self._lock:
            self._pending = None
            self._number += 1
            self._resetting = self._resetting or threading.Event()
            return self._resetting

    def outcome(self, number: int) -> str:
        """What has become of a command: RUNNING, DONE or REPLACED."""
        with self._lock:
            if number != self._number:
                return REPLACED
            if self._started != number:
                return RUNNING
            return DONE if self._path is None or self.time >= self._path.end else RUNNING

    def _command(self, command: Trajectory | Goal | Floats | None, delay: float) -> int:
        with self._lock:
            self._number += 1
            self._pending = command, delay
            return self._number

    def tick(self) -> SimState:
        """Move the arm for one period, and return its state."""
        with self._lock:
            pending, self._pending = self._pending, None
            resetting, self._resetting = self._resetting, None
            self._started = self._number
            if resetting is not None:
                self._put_at_home()
            if pending is not None:
                self._begin(*pending)
            if self._path is not None:
                self._reference, self._velocity = self._path.at(self.time + self.period)
        target = np.clip(self._reference, *self._limits)
        self.state = self.backend.step(target[None])
        with self._lock:
            self.ticks += 1
        if resetting is not None:
            resetting.set()
        return self.state

    def _put_at_home(self) -> None:
        if self.backend.random:
            seeds = self._random.integers(2**63, size=1, dtype=np.uint64)
            self.backend.begin_episodes(seeds, np.ones(1, np.bool_))
        self._path = None
        self._reference, self._velocity = self.robot.home.copy(), np.zeros(self.robot.num_joints)
        self.backend.reset(self._reference[None])
        self.state = self.backend.state
        """The state after the last tick."""

    def _begin(self, command: Trajectory | Goal | Floats | None, delay: float) -> None:
        """Begin to follow a command, from the reference."""
        now = self.time
        if isinstance(command, Trajectory):
            self._path = Path(now, self._reference, self._velocity, command, now + delay)
            return
        if isinstance(command, Goal):
            near = command._replace(q=np.clip(command.q, *self._limits))
            self._path = ServoWay(now, self._reference, near)
            return
        self._path = None
        self._reference = self.state.q[0].copy() if command is None else command
        self._reference = np.clip(self._reference, *self._limits)
        self._velocity = np.zeros(len(self._reference))


class Pace:
    """Ticks at a fixed rate by a clock. Ticks that are missed are counted, and not made up for.

    Args:
        period: s.
        clock: the clock.
    """

    def __init__(self, period: float, clock: Clock) -> None:
        self._period, self._clock = period, clock
        self._due: float | None = None
        self.missed = 0
        """How many ticks were left out, because their time had passed."""

    def wait(self) -> None:
        """Return when the next tick is due; the first time at once."""
        now = self._clock.now()
        due = now if self._due is None else self._due + self._period
        if now - due >= self._period:
            left_out = int((now - due) // self._period)
            self.missed += left_out
            due += left_out * self._period
        self._clock.sleep_until(due)
        self._due = due
