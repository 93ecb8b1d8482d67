"""The dynamic backend: DART integrates the motion of the arms, with position servos, contact and random parameters."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.dart.arm import DartArm
from gym_mara.backends.dart.shapes import DETECTORS
from gym_mara.backends.randomisation import Randomisation
from gym_mara.backends.servo import Motion, ServoBackend, servo_motion
from gym_mara.errors import GymMaraError, one_of
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import Contact, SimState
from gym_mara.types import Floats, Mask

MOST_LATE_PERIODS = 1000
"""The longest latency, control periods."""
# The parameters that the engine needs to know; the servos and the sensors take care of the others.
_OF_ENGINE = ("mass", "effort_limit", "joint_friction", "contact_friction")


class DartBackend(ServoBackend):
    """Full dynamics by DART, each arm in its own world.

    Args:
        robot: the arm.
        num_envs: the number of arms.
        control_period: s.
        physics_step: s; a control period is a whole number of them.
        max_joint_velocity: rad/s (m/s), where it is below the URDF's limits; None for those.
        servo_gain: 1/s.
        on_divergence: what follows when an arm's state diverges: "error", or "truncate" to end the arm's episode.
        detector: DART's collision detector: "fcl", "dart", "bullet" or "ode".
        randomisation: name → (lowest, highest), drawn for each arm at the beginning of each episode; see
            `gym_mara.backends.randomisation`.

    Raises:
        GymMaraError: a setting is out of its range, or DART does not know a shape of the robot.
    """

    in_processes = True  # DART holds Python's lock while it steps
    most_arms = 2**14  # each has a world of about 0.7 MB

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
        detector: str = "fcl",
        randomisation: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        super().__init__(
            robot,
            num_envs,
            control_period=control_period,
            physics_step=physics_step,
            max_joint_velocity=max_joint_velocity,
            servo_gain=servo_gain,
            on_divergence=on_divergence,
        )
        self._settings |= {"detector": detector, "randomisation": randomisation}
        self.detector = one_of("detector", detector, DETECTORS)
        self.randomisation = Randomisation({} if randomisation is None else randomisation, robot)
        self.random = bool(self.randomisation.ranges)
        self._parameters = {
            name: np.repeat(value[None], num_envs, axis=0)
            for name, value in self.randomisation.nominal().items()
        }
        self.arms: list[DartArm] = []
        for _ in range(num_envs):
            self.arms.append(self._new_arm())
        # The latest targets (N, D, J), the newest last: as many as the longest latency needs.
        longest = self.randomisation.ranges.get("latency", (0.0, 0.0))[1]
        periods = longest / self.control_period
        if periods > MOST_LATE_PERIODS:
            raise GymMaraError(
                f"the latency must be at most {MOST_LATE_PERIODS} control periods of {self.control_period:g} s, because "
                f"the targets of that time are kept; not {longest:g} s"
            )
        self._targets = np.stack([self._q] * (int(longest // self.control_period) + 2), axis=1)
        self._latency = np.zeros((num_envs, 1))
        self.reset(np.tile(robot.home, (num_envs, 1)))

    def _new_arm(self) -> DartArm:
        return DartArm(
            self.robot,
            self.physics_step,
            self.detector,
            velocity_limit=self.joint_velocity,
            like=self.arms[0] if self.arms else None,
        )

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: Mask) -> None:
        for index in np.flatnonzero(mask).tolist():
            for name, value in self.randomisation.draw(int(seeds[index])).items():
                self._parameters[name][index] = value
            self._apply_parameters(index)

    def _apply_parameters(self, index: int) -> None:
        own = {name: values[index] for name, values in self._parameters.items()}
        self._gain[index] = self.servo_gain * own.get("servo_gain", 1.0)
        self._latency[index] = own.get("latency", 0.0)
        self.arms[index].set_parameters(**{n: own[n] for n in _OF_ENGINE if n in own})

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        super().reset(q, mask)
        rows: Any = slice(None) if mask is None else mask
        self._targets[rows] = q[rows, None]

    def step(self, q_target: Floats) -> SimState:
        self._targets = np.concatenate([self._targets[:, 1:], q_target[:, None]], axis=1)
        return super().step(q_target)

    def _commands(self, q_target: Floats) -> Floats:
        if "latency" not in self._parameters:
            return super()._commands(q_target)
        late = self._latency // self.control_period  # whole periods by which a target is late
        change = self._latency - late * self.control_period  # when in this period it takes effect
        arms, newest = np.arange(self.num_envs), -1 - late[:, 0].astype(np.int64)
        new, old = self._targets[arms, newest], self._targets[arms, newest - 1]
        limits = self._gain, self.joint_velocity
        path = servo_motion(self._q, old, *limits, np.minimum(self._times, change))
        then = np.maximum(self._times - change, 0.0)
        path = path + servo_motion(self._q + path[-1], new, *limits, then)
        return (path[1:] - path[:-1]) / self.physics_step

    def _run(self, velocities: Floats) -> Motion:
        contacts = [arm.run(velocities[:, index]) for index, arm in enumerate(self.arms)]
        return Motion(
            np.array([arm.q for arm in self.arms]),
            np.array([arm.qd for arm in self.arms]),
            np.array([arm.torque for arm in self.arms]),
            contacts,
        )

    def _put_at_rest(self, arm: int, q: Floats) -> tuple[Contact, ...]:
        self.arms[arm].reset(q)
        return self.arms[arm].contacts()

    def _rebuild(self, arm: int, q: Floats, qd: Floats) -> None:
        self.arms[arm] = self._new_arm()
        self._apply_parameters(arm)
        self.arms[arm].set_state(q, qd)

    def save(self) -> dict[str, Any]:
        return super().save() | {"targets": self._targets.copy()} | self._followers()

    def _followers(self) -> dict[str, Floats]:
        """The state of the joints that follow others (N, 2, F), if the robot has any."""
        if not self.robot.followers:
            return {}
        return {"followers": np.array([arm.followers for arm in self.arms])}

    def restore(self, snapshot: dict[str, Any]) -> None:
        check_fits("targets", snapshot.get("targets"), self._targets)
        for name, own in self._followers().items():
            check_fits(name, snapshot.get(name), own)
        super().restore(snapshot)
        self._targets = copy.copy(snapshot["targets"])
        for index, arm in enumerate(self.arms):
            self._apply_parameters(index)
            arm.set_state(self._q[index], self._qd[index])
            if self.robot.followers:
                arm.followers = snapshot["followers"][index]
