"""What dynamic backends share: position servos, random parameters, latency, and arms whose state can diverge."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.base import Backend, limited_velocity
from gym_mara.backends.randomisation import Randomisation
from gym_mara.backends.servo_motion import (
    has_diverged,
    late_servo_motion,
    servo_motion,
    step_times,
)
from gym_mara.errors import GymMaraError, one_of, positive_number
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import Contact, SimState
from gym_mara.types import Floats, Mask

ON_DIVERGENCE = ("error", "truncate")
MOST_LATE_PERIODS = 1000
"""The longest latency, control periods."""
_STATE = ("q", "qd", "torque", "contacts", "time", "diverged", "parameters", "targets")


class SimulationDivergedError(GymMaraError):
    """The physics engine computed a state that is not finite, or velocities far beyond all limits."""


class Motion(NamedTuple):
    """What a physics engine computed for one control period."""

    q: Floats
    """Joint positions at its end (N, J), rad (m for a prismatic joint)."""
    qd: Floats
    """Joint velocities at its end (N, J), rad/s (m/s)."""
    torque: Floats
    """What the motors exerted in the last physics step (N, J), Nm (N)."""
    contacts: list[tuple[Contact, ...]]
    """The contacts of each arm (N,) in any physics step, each pair of links once."""


class ServoBackend(Backend):
    """Full dynamics: gravity, inertia, contact, and motors with limits of velocity and effort.

    Each joint has a position servo: its motor is commanded the velocity clip(gain · (target - q), ± the limit of velocity)
    at every physics step, and exerts what torque that takes, up to the effort limit. Joints have end stops at their limits.
    The state has the engine's joint positions, and its velocities clipped to the limits. A subclass adds the engine: it
    implements `_run`, `_put_at_rest`, `_rebuild` and `_set_parameters`, and calls `reset` at the end of its constructor.

    Args:
        robot: the arm.
        num_envs: N.
        control_period: s.
        physics_step: s; a control period is a whole number of them.
        max_joint_velocity: rad/s (m/s), where it is below the URDF's limits; None for those.
        servo_gain: 1/s.
        on_divergence: what follows when an arm's state diverges: "error", or "truncate" to end the arm's episode.
        randomisation: name → (lowest, highest), drawn for each arm at the beginning of each episode; see
            `gym_mara.backends.randomisation`.

    Raises:
        GymMaraError: a setting is out of its range.
        SimulationDivergedError: from `step`, where an arm's state diverges and `on_divergence` is "error".
    """

    dynamic = True
    overshoot = 0.01

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        physics_step: float = 0.001,
        max_joint_velocity: float | None = None,
        servo_gain: float = 10.0,
        on_divergence: str = "error",
        randomisation: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        self._settings: dict[str, Any] = {
            "control_period": control_period,
            "physics_step": physics_step,
            "max_joint_velocity": max_joint_velocity,
            "servo_gain": servo_gain,
            "on_divergence": on_divergence,
            "randomisation": randomisation,
        }
        """The keyword arguments that make the same backend again; a subclass adds its own."""
        self.physics_step = positive_number("physics_step", physics_step, "s")
        self._times = step_times(self.control_period, self.physics_step)[:, None, None]
        if max_joint_velocity is not None:
            self.joint_velocity = limited_velocity(robot, max_joint_velocity)
        self.servo_gain = positive_number("servo_gain", servo_gain, "1/s")
        self.on_divergence = one_of("on_divergence", on_divergence, ON_DIVERGENCE)
        self.randomisation = Randomisation({} if randomisation is None else randomisation, robot)
        self.random = bool(self.randomisation.ranges)
        self._kinematics = robot.kinematics()
        shape = (num_envs, robot.num_joints)
        self._gain = np.full(shape, self.servo_gain)
        # As the engine has them, so possibly a little beyond the limits.
        self._q, self._qd, self._torque = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._contacts: list[tuple[Contact, ...]] = [()] * num_envs
        self._time = np.zeros(num_envs)
        self._period = np.array(self.control_period)  # NumPy adds it faster than a Python number
        self._diverged = np.zeros(num_envs, np.bool_)
        self._parameters = {
            name: np.repeat(value[None], num_envs, axis=0)
            for name, value in self.randomisation.nominal().items()
        }
        # The latest targets (N, D, J), the newest last: as many as the longest latency needs.
        self._targets = np.stack(
            [self._q] * (late_periods(self.randomisation, control_period) + 2), axis=1
        )
        self._latency = np.zeros((num_envs, 1))

    @abstractmethod
    def _run(self, velocities: Floats) -> Motion:
        """Run all arms for one physics step per row of commanded joint velocities (K, N, J)."""

    @abstractmethod
    def _put_at_rest(self, arms: NDArray[np.intp], q: Floats) -> list[tuple[Contact, ...]]:
        """Put the n arms with these numbers at rest at q (n, J); returns the contacts of each there."""

    def _set_state(self, arm: int, q: Floats, qd: Floats) -> None:
        """Put one arm at q with velocities qd, both (J,); a subclass may do so without a new arm."""
        self._rebuild(arm, q, qd)

    @abstractmethod
    def _rebuild(self, arm: int, q: Floats, qd: Floats) -> None:
        """Replace what the engine knows of one arm, whose state diverged, by a new arm at q and qd, both (J,)."""

    @abstractmethod
    def _set_parameters(self, arm: int, parameters: Mapping[str, Floats]) -> None:
        """Give one arm its random parameters (those of its episode); latency and servo gain are not the engine's."""

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: Mask) -> None:
        for arm in np.flatnonzero(mask).tolist():
            for name, value in self.randomisation.draw(int(seeds[arm])).items():
                self._parameters[name][arm] = value
            self._apply_parameters(arm)

    def _apply_parameters(self, arm: int) -> None:
        own = {name: values[arm] for name, values in self._parameters.items()}
        self._gain[arm] = self.servo_gain * own.get("servo_gain", 1.0)
        self._latency[arm] = own.get("latency", 0.0)
        self._set_parameters(arm, own)

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        rows = np.ones(self.num_envs, np.bool_) if mask is None else mask
        arms = np.flatnonzero(rows)
        for arm, contacts in zip(arms.tolist(), self._put_at_rest(arms, q[arms]), strict=True):
            self._contacts[arm] = contacts
        self._q[rows], self._qd[rows], self._torque[rows] = q[rows], 0.0, 0.0
        self._targets[rows] = q[rows, None]
        self._time[rows], self._diverged[rows] = 0.0, False

    def set_parameters(self, parameters: Mapping[str, Floats]) -> None:
        """Give all arms these values instead of random ones: name → (N, …), for names that `randomisation` has."""
        for name, values in parameters.items():
            self._parameters[name][:] = values
        for arm in range(self.num_envs):
            self._apply_parameters(arm)

    def continue_from(self, q: Floats, qd: Floats, targets: Floats) -> None:
        """Put all arms in a recorded state, in motion and with the targets that may not have taken effect yet.

        Args:
            q: joint positions (N, J), rad (m).
            qd: joint velocities (N, J), rad/s (m/s).
            targets: the joint targets so far (K, J), the newest last; before the first one it was the same.
        """
        kept = np.maximum(np.arange(-self._targets.shape[1], 0), -len(targets))
        self._targets[:] = targets[kept]
        self._q[:], self._qd[:], self._torque[:] = q, qd, 0.0
        self._contacts = [()] * self.num_envs
        self._diverged[:] = False
        for arm in range(self.num_envs):
            self._set_state(arm, self._q[arm], self._qd[arm])

    def step(self, q_target: Floats) -> SimState:
        self._targets[:, :-1] = self._targets[:, 1:]
        self._targets[:, -1] = q_target
        motion = self._run(self._commands(q_target))
        self._time += self._period
        self._diverged = has_diverged(motion.q, motion.qd, self.joint_velocity)
        diverged = np.count_nonzero(self._diverged)
        if diverged:
            self._go_back(motion)
        self._q, self._qd, self._torque, self._contacts = motion
        if diverged and self.on_divergence == "error":
            first = int(self._diverged.argmax())
            raise simulation_diverged(self.first_arm + first, self._time[first])
        return self.state

    def _commands(self, q_target: Floats) -> Floats:
        """The velocities that the servos command at each physics step of the next control period (K, N, J)."""
        limits = self._gain, self.joint_velocity
        if "latency" in self._parameters:
            # A target is late by whole periods, and takes effect at a time within this one.
            late = self._latency // self.control_period
            change = self._latency - late * self.control_period
            arms, newest = np.arange(self.num_envs), -1 - late[:, 0].astype(np.int64)
            both = self._targets[arms, newest - 1], self._targets[arms, newest]
            path = late_servo_motion(self._q, both, *limits, self._times, change)
        else:
            path = servo_motion(self._q, q_target, *limits, self._times)
        return (path[1:] - path[:-1]) / self.physics_step

    def _go_back(self, motion: Motion) -> None:
        """Put the arms whose state diverged back to where they were before the step; what they touched there was no contact."""
        diverged = self._diverged
        motion.q[diverged], motion.qd[diverged] = self._q[diverged], self._qd[diverged]
        motion.torque[diverged] = 0.0
        for arm in np.flatnonzero(diverged).tolist():
            motion.contacts[arm] = ()
            self._rebuild(arm, self._q[arm], self._qd[arm])

    @property
    def state(self) -> SimState:
        q = self._q.copy()
        # In half the time of clip for one arm.
        qd = np.minimum(np.maximum(self._qd, -self.joint_velocity), self.joint_velocity)
        position, quaternion, velocity = self._kinematics.motion(q, qd)
        parameters = {name: values.copy() for name, values in self._parameters.items()}
        return SimState(
            q=q,
            qd=qd,
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=velocity,
            collided=np.array([bool(contacts) for contacts in self._contacts]),
            time=self._time.copy(),
            torque=self._torque.copy(),
            contacts=tuple(self._contacts),
            diverged=self._diverged.copy() if self.on_divergence == "truncate" else None,
            parameters=parameters or None,
        )

    def save(self) -> dict[str, Any]:
        return {name: copy.deepcopy(getattr(self, f"_{name}")) for name in _STATE}

    def restore(self, snapshot: dict[str, Any]) -> None:
        form: dict[str, Any] = {name: getattr(self, f"_{name}") for name in _STATE}
        form["contacts"] = [tuple] * self.num_envs
        # A subclass adds values to the snapshot, and checks them itself.
        check_fits("backend", {name: snapshot.get(name) for name in _STATE}, form)
        for name in _STATE:
            setattr(self, f"_{name}", copy.deepcopy(snapshot[name]))
        for arm in range(self.num_envs if self.random else 0):
            self._apply_parameters(arm)

    def __reduce__(self) -> tuple[Any, ...]:
        return made_again, (type(self), self.robot, self.num_envs, self._settings, self.save())


def late_periods(randomisation: Randomisation, control_period: float) -> int:
    """The number of whole control periods in the longest latency.

    Raises:
        GymMaraError: it is more than MOST_LATE_PERIODS.
    """
    longest = randomisation.ranges.get("latency", (0.0, 0.0))[1]
    if longest / control_period > MOST_LATE_PERIODS:
        raise GymMaraError(
            f"the latency must be at most {MOST_LATE_PERIODS} control periods of {control_period:g} s, because the targets "
            f"of that time are kept; not {longest:g} s"
        )
    return int(longest // control_period)


def simulation_diverged(arm: int, time: float) -> SimulationDivergedError:
    """The error for an arm whose state diverged at this time after its reset, s."""
    return SimulationDivergedError(
        f"the simulation of arm {arm} diverged {time:.3f} s after its reset; a shorter physics_step may help, or "
        "on_divergence='truncate' to end such episodes"
    )


def made_again(
    backend: type[Backend],
    robot: RobotModel,
    num_envs: int,
    settings: dict[str, Any],
    snapshot: dict[str, Any],
) -> Backend:
    """A backend with the state of a snapshot, for pickle and copy."""
    made = backend(robot, num_envs, **settings)
    made.restore(snapshot)
    return made
