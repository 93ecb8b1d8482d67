"""What dynamic backends share: position servos, planned one control period ahead, and arms whose state can diverge."""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import Any, NamedTuple

import numpy as np

from gym_mara.backends.base import Backend, limited_velocity
from gym_mara.errors import GymMaraError, one_of, positive_number
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import Contact, SimState
from gym_mara.types import Floats, Mask

ON_DIVERGENCE = ("error", "truncate")
DIVERGED_VELOCITY = 1e3
"""A joint this many times as fast as its limit has diverged."""
MOST_PHYSICS_STEPS = 10_000
"""The largest number of physics steps in a control period."""
_STATE = ("q", "qd", "torque", "contacts", "time", "diverged", "parameters")


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
    implements `_run`, `_put_at_rest` and `_rebuild`, and calls `reset` at the end of its constructor.

    Args:
        robot: the arm.
        num_envs: N.
        control_period: s.
        physics_step: s; a control period is a whole number of them.
        max_joint_velocity: rad/s (m/s), where it is below the URDF's limits; None for those.
        servo_gain: 1/s.
        on_divergence: what follows when an arm's state diverges: "error", or "truncate" to end the arm's episode.

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
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        self._settings: dict[str, Any] = {
            "control_period": control_period,
            "physics_step": physics_step,
            "max_joint_velocity": max_joint_velocity,
            "servo_gain": servo_gain,
            "on_divergence": on_divergence,
        }
        """The keyword arguments that make the same backend again; a subclass adds its own."""
        self.physics_step = positive_number("physics_step", physics_step, "s")
        self._times = step_times(self.control_period, self.physics_step)[:, None, None]
        if max_joint_velocity is not None:
            self.joint_velocity = limited_velocity(robot, max_joint_velocity)
        self.servo_gain = positive_number("servo_gain", servo_gain, "1/s")
        self.on_divergence = one_of("on_divergence", on_divergence, ON_DIVERGENCE)
        self._kinematics = robot.kinematics()
        shape = (num_envs, robot.num_joints)
        self._gain = np.full(shape, self.servo_gain)
        # As the engine has them, so possibly a little beyond the limits.
        self._q, self._qd, self._torque = np.zeros(shape), np.zeros(shape), np.zeros(shape)
        self._contacts: list[tuple[Contact, ...]] = [()] * num_envs
        self._time = np.zeros(num_envs)
        self._diverged = np.zeros(num_envs, np.bool_)
        self._parameters: dict[str, Floats] = {}

    @abstractmethod
    def _run(self, velocities: Floats) -> Motion:
        """Run all arms for one physics step per row of commanded joint velocities (K, N, J)."""

    @abstractmethod
    def _put_at_rest(self, arm: int, q: Floats) -> tuple[Contact, ...]:
        """Put one arm at rest at q (J,); returns the contacts there."""

    @abstractmethod
    def _rebuild(self, arm: int, q: Floats, qd: Floats) -> None:
        """Replace what the engine knows of one arm, whose state diverged, by a new arm at q and qd, both (J,)."""

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        rows = np.ones(self.num_envs, np.bool_) if mask is None else mask
        for arm in np.flatnonzero(rows).tolist():
            self._contacts[arm] = self._put_at_rest(arm, q[arm])
        self._q[rows], self._qd[rows], self._torque[rows] = q[rows], 0.0, 0.0
        self._time[rows], self._diverged[rows] = 0.0, False

    def step(self, q_target: Floats) -> SimState:
        motion = self._run(self._commands(q_target))
        self._time += self.control_period
        self._diverged = has_diverged(motion.q, motion.qd, self.joint_velocity)
        if np.count_nonzero(self._diverged):
            self._go_back(motion)
        self._q, self._qd, self._torque, self._contacts = motion
        return self.state

    def _commands(self, q_target: Floats) -> Floats:
        """The velocities that the servos command at each physics step of the next control period (K, N, J)."""
        path = servo_motion(self._q, q_target, self._gain, self.joint_velocity, self._times)
        return (path[1:] - path[:-1]) / self.physics_step

    def _go_back(self, motion: Motion) -> None:
        """Put the arms whose state diverged back to where they were before the step."""
        diverged = self._diverged
        motion.q[diverged], motion.qd[diverged] = self._q[diverged], self._qd[diverged]
        motion.torque[diverged] = 0.0
        for arm in np.flatnonzero(diverged).tolist():
            self._rebuild(arm, self._q[arm], self._qd[arm])
        if self.on_divergence == "error":
            first = int(diverged.argmax())
            raise SimulationDivergedError(
                f"the simulation of arm {first} diverged {self._time[first]:.3f} s after its reset; a shorter "
                "physics_step may help, or on_divergence='truncate' to end such episodes"
            )

    @property
    def state(self) -> SimState:
        q = self._q.copy()
        qd = self._qd.clip(-self.joint_velocity, self.joint_velocity)
        position, quaternion = self._kinematics.pose(q)
        parameters = {name: values.copy() for name, values in self._parameters.items()}
        return SimState(
            q=q,
            qd=qd,
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=self._kinematics.velocity(q, qd),
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

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (type(self), self.robot, self.num_envs, self._settings, self.save())


def _restored(
    backend: type[Backend],
    robot: RobotModel,
    num_envs: int,
    settings: dict[str, Any],
    snapshot: dict[str, Any],
) -> Backend:
    made = backend(robot, num_envs, **settings)
    made.restore(snapshot)
    return made


def has_diverged(q: Floats, qd: Floats, velocity_limit: Floats) -> Mask:
    """Which arms have a state, q and q̇ (..., J), that is not finite or is far beyond the velocity limits (J,)."""
    sane = np.isfinite(q) & (np.abs(qd) < DIVERGED_VELOCITY * velocity_limit)
    return np.logical_not(np.logical_and.reduce(sane, axis=-1))


def step_times(control_period: float, physics_step: float) -> Floats:
    """The times between the physics steps of a control period, from 0 to the period (K + 1,), s.

    Raises:
        GymMaraError: a control period is not a whole number of physics steps, or has too many.
    """
    if control_period / physics_step > MOST_PHYSICS_STEPS:
        raise GymMaraError(
            f"a control period of {control_period:g} s must have at most {MOST_PHYSICS_STEPS} physics steps, because a step "
            f"of the environment computes them all; with physics_step {physics_step:g} s it has {control_period / physics_step:g}"
        )
    steps = round(control_period / physics_step)
    if steps < 1 or abs(steps * physics_step - control_period) > 1e-9:
        raise GymMaraError(
            f"physics_step {physics_step} s must divide the control period, {control_period} s, "
            f"as {control_period / max(steps, 1):g} s does"
        )
    return physics_step * np.arange(steps + 1, dtype=np.float64)


def servo_motion(
    q: Floats, q_target: Floats, gain: Floats, velocity_limit: Floats, time: Floats
) -> Floats:
    """How far joints have moved at a time under the law q̇ = clip(gain · (q_target - q), ±velocity_limit).

    A joint moves at the limit as long as the law asks for more, then approaches its target exponentially: it does not
    overshoot.

    Args:
        q: current positions (..., J), rad.
        q_target: target positions (..., J), rad.
        gain: 1/s, (..., J).
        velocity_limit: rad/s, (..., J).
        time: from now, s; broadcasts against the others.

    Returns:
        The displacements, rad, of the broadcast shape.
    """
    way = q_target - q
    slow_zone = velocity_limit / gain  # within this distance the law asks for less than the limit
    distance = np.abs(way)
    slow_way = np.minimum(distance, slow_zone)
    fast_time = (distance - slow_way) / velocity_limit
    fast = np.minimum(time, fast_time)
    slow = slow_way * np.expm1(gain * (fast - time))
    return np.copysign(fast * velocity_limit - slow, way)
