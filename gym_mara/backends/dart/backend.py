"""The dynamic backend: DART integrates the arms' motion, with position servos on the joints and contact."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.base import Backend
from gym_mara.backends.dart.arm import Contact, DartArm, is_lost
from gym_mara.backends.randomisation import Randomisation
from gym_mara.backends.servo import servo_motion, step_times
from gym_mara.errors import GymMaraError, positive_number, unknown
from gym_mara.robot import RobotModel
from gym_mara.state import SimState

Floats = NDArray[np.float64]

ON_DIVERGENCE = ("error", "truncate")
# The parameters that the physics engine is told of; the others are the backend's business.
_OF_ARM = ("mass", "effort_limit", "joint_friction", "contact_friction")


class SimulationDivergedError(GymMaraError):
    """The physics engine lost an arm: its state is no longer finite."""


class DartBackend(Backend):
    """Full dynamics: gravity, inertia, contact, and motors that are only so strong and so fast.

    Each joint has a position servo: its motor is commanded the velocity clip(gain · (target - q), ± the URDF's velocity
    limit) at every physics step, and exerts what torque that takes up to the URDF's effort limit.

    Args:
        robot: the arm.
        num_envs: how many of it, each in a world of its own.
        control_period: s.
        physics_step: s; a whole number of them makes a control period.
        max_joint_velocity: rad/s (m/s), where it is below the URDF's limits; None for those.
        servo_gain: 1/s.
        detector: DART's collision detector: "fcl", "dart", "bullet" or "ode".
        randomisation: name → (lowest, highest), drawn for each arm at the beginning of each episode; see
            `gym_mara.backends.randomisation`.
        on_divergence: what follows when the engine loses an arm: "error", or "truncate" to end the arm's episode.
    """

    in_processes = True  # DART holds Python's lock while it steps

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        physics_step: float = 0.001,
        max_joint_velocity: float | None = None,
        servo_gain: float = 10.0,
        detector: str = "fcl",
        randomisation: Mapping[str, Sequence[float]] | None = None,
        on_divergence: str = "error",
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        self._settings = {
            "control_period": control_period,
            "physics_step": physics_step,
            "max_joint_velocity": max_joint_velocity,
            "servo_gain": servo_gain,
            "detector": detector,
            "randomisation": randomisation,
            "on_divergence": on_divergence,
        }
        self.physics_step = positive_number("physics_step", physics_step, "s")
        self._times = step_times(self.control_period, self.physics_step)[:, None, None]
        if max_joint_velocity is not None:
            limit = positive_number("max_joint_velocity", max_joint_velocity, "rad/s")
            self.joint_velocity = np.minimum(limit, robot.velocity_limit)
        self.servo_gain = positive_number("servo_gain", servo_gain, "1/s")
        if on_divergence not in ON_DIVERGENCE:
            raise unknown("on_divergence", on_divergence, ON_DIVERGENCE)
        self.on_divergence = on_divergence
        self.randomisation = Randomisation(randomisation or {}, robot)
        self.random = bool(self.randomisation.ranges)
        self.detector = detector
        self._kinematics = robot.kinematics()
        self.arms: list[DartArm] = []
        for _ in range(num_envs):
            self.arms.append(self._new_arm())
        self._parameters = [self.randomisation.nominal() for _ in range(num_envs)]
        self._gain = np.full((num_envs, robot.num_joints), self.servo_gain)
        # (N, D, J), the newest target last; as many as a late command may have to wait for.
        longest = self.randomisation.ranges.get("latency", (0.0, 0.0))[1]
        self._targets = np.stack([self._gain] * (int(longest // self.control_period) + 2), axis=1)
        self._latency = np.zeros((num_envs, 1))
        self._time = np.zeros(num_envs)
        # Of the arms as the engine has them, (N, J).
        self._q, self._qd, self._torque = (np.zeros_like(self._gain) for _ in range(3))
        self._contacts: list[list[Contact]] = [[] for _ in range(num_envs)]
        self.reset(np.tile(robot.home, (num_envs, 1)))

    def _new_arm(self) -> DartArm:
        return DartArm(
            self.robot,
            self.physics_step,
            self.detector,
            velocity_limit=self.joint_velocity,
            like=self.arms[0] if self.arms else None,
        )

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: NDArray[np.bool_]) -> None:
        for index in np.flatnonzero(mask).tolist():
            drawn = self.randomisation.draw(int(seeds[index]))
            self._set_parameters(index, drawn)

    def _set_parameters(self, index: int, parameters: dict[str, Floats]) -> None:
        self._parameters[index] = parameters
        self._gain[index] = self.servo_gain * parameters.get("servo_gain", 1.0)
        self._latency[index] = parameters.get("latency", 0.0)
        self.arms[index].set_parameters(
            **{name: parameters[name] for name in _OF_ARM if name in parameters}  # type: ignore[arg-type]
        )

    @property
    def sensor_noise(self) -> Floats | None:
        if "sensor_noise" not in self.randomisation.ranges:
            return None
        return np.array([parameters["sensor_noise"] for parameters in self._parameters])

    def reset(self, q: Floats, mask: NDArray[np.bool_] | None = None) -> None:
        rows = np.ones(self.num_envs, np.bool_) if mask is None else mask
        for index in np.flatnonzero(rows).tolist():
            self.arms[index].reset(q[index])
            self._contacts[index] = self.arms[index].contacts()
        self._q[rows], self._qd[rows], self._torque[rows] = q[rows], 0.0, 0.0
        self._targets[rows] = q[rows, None]
        self._time[rows] = 0.0

    def step(self, q_target: Floats) -> SimState:
        self._targets = np.concatenate([self._targets[:, 1:], q_target[:, None]], axis=1)
        commands = self._commands(self._q)
        for index, arm in enumerate(self.arms):
            self._contacts[index] = arm.run(commands[:, index])
        before = self._q, self._qd
        self._q, self._qd = np.array([a.q for a in self.arms]), np.array([a.qd for a in self.arms])
        self._torque = np.array([arm.torque for arm in self.arms])
        self._time += self.control_period
        self.diverged = None
        lost = is_lost(self._q, self._qd, self.joint_velocity)
        if np.count_nonzero(lost):
            self._give_up(lost, *before)
        return self.state

    def _commands(self, q: Floats) -> Floats:
        """The velocities (K, N, J) that the servos command at each physics step of a period, from q (N, J)."""
        if "latency" not in self.randomisation.ranges:
            path = servo_motion(
                q, self._targets[:, -1], self._gain, self.joint_velocity, self._times
            )
            return (path[1:] - path[:-1]) / self.physics_step
        late = self._latency // self.control_period  # whole periods by which a target is late
        change = self._latency - late * self.control_period  # when in this period it takes effect
        arms, newest = np.arange(self.num_envs), -1 - late[:, 0].astype(np.int64)
        new, old = self._targets[arms, newest], self._targets[arms, newest - 1]
        limits = self._gain, self.joint_velocity
        path = servo_motion(q, old, *limits, np.minimum(self._times, change))
        then = np.maximum(self._times - change, 0.0)
        path = path + servo_motion(q + path[-1], new, *limits, then)
        return (path[1:] - path[:-1]) / self.physics_step

    def _give_up(self, lost: NDArray[np.bool_], q: Floats, qd: Floats) -> None:
        """See to the arms that the engine has lost (N,): theirs is the state before, q and q̇ (N, J)."""
        for index in np.flatnonzero(lost).tolist():
            if self.on_divergence == "error":
                raise SimulationDivergedError(
                    f"the simulation of arm {index} diverged {self._time[index]:.3f} s after its reset; a shorter "
                    "physics_step may help, or on_divergence='truncate' to end such episodes"
                )
            self.arms[index] = self._new_arm()
            self._set_parameters(index, self._parameters[index])
            self._q[index], self._qd[index], self._torque[index] = q[index], qd[index], 0.0
            self.arms[index].set_state(q[index], qd[index])
        self.diverged = lost

    def __reduce__(self) -> tuple[Any, ...]:
        return _restored, (self.robot, self.num_envs, self._settings, self.save())

    @property
    def state(self) -> SimState:
        # A servo that holds a joint at its limit lets it slip past by some 1e-9 rad.
        q = self._q.clip(self.robot.lower, self.robot.upper)
        qd = self._qd.clip(-self.joint_velocity, self.joint_velocity)
        position, quaternion = self._kinematics.pose(q)
        return SimState(
            q=q,
            qd=qd,
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=self._kinematics.velocity(q, qd),
            collided=np.array([bool(contacts) for contacts in self._contacts]),
            time=self._time.copy(),
        )

    def report(self) -> dict[str, NDArray[Any]]:
        contacts = np.empty(self.num_envs, dtype=object)
        for index, found in enumerate(self._contacts):
            contacts[index] = [contact._asdict() for contact in found]
        return {
            "joint_torque": self._torque.copy(),
            "contacts": contacts,
            **{
                name: np.array([p[name] for p in self._parameters])
                for name in self.randomisation.ranges
            },
        }

    def save(self) -> dict[str, Any]:
        return copy.deepcopy(
            {
                "q": self._q,
                "qd": self._qd,
                "parameters": self._parameters,
                "targets": self._targets,
                "time": self._time,
                "torque": self._torque,
                "contacts": self._contacts,
            }
        )

    def restore(self, snapshot: dict[str, Any]) -> None:
        if snapshot["q"].shape != self._q.shape:
            raise GymMaraError(
                f"the snapshot is of arms {snapshot['q'].shape}; these are {self._q.shape}"
            )
        snapshot = copy.deepcopy(snapshot)
        self._q, self._qd = snapshot["q"], snapshot["qd"]
        for index, arm in enumerate(self.arms):
            self._set_parameters(index, snapshot["parameters"][index])
            arm.set_state(self._q[index], self._qd[index])
        self._targets, self._time = snapshot["targets"], snapshot["time"]
        self._torque, self._contacts = snapshot["torque"], snapshot["contacts"]


def _restored(
    robot: RobotModel, num_envs: int, settings: dict[str, Any], snapshot: dict[str, Any]
) -> DartBackend:
    backend = DartBackend(robot, num_envs, **settings)
    backend.restore(snapshot)
    return backend
