"""The dynamic backend: DART integrates the motion of the arms, with position servos, contact and random parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.dart.arm import DartArm
from gym_mara.backends.dart.shapes import DETECTORS
from gym_mara.backends.servo import Motion, ServoBackend
from gym_mara.errors import one_of
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import Contact
from gym_mara.types import Floats

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
            randomisation=randomisation,
        )
        self._settings["detector"] = detector
        self.detector = one_of("detector", detector, DETECTORS)
        self.arms: list[DartArm] = []
        for _ in range(num_envs):
            self.arms.append(self._new_arm())
        self.reset(np.tile(robot.home, (num_envs, 1)))

    def _new_arm(self) -> DartArm:
        return DartArm(
            self.robot,
            self.physics_step,
            self.detector,
            velocity_limit=self.joint_velocity,
            like=self.arms[0] if self.arms else None,
        )

    def _set_parameters(self, arm: int, parameters: Mapping[str, Floats]) -> None:
        own: dict[str, Any] = {n: parameters[n] for n in _OF_ENGINE if n in parameters}
        self.arms[arm].set_parameters(**own)

    def _run(self, velocities: Floats) -> Motion:
        contacts = [arm.run(velocities[:, index]) for index, arm in enumerate(self.arms)]
        return Motion(
            np.array([arm.q for arm in self.arms]),
            np.array([arm.qd for arm in self.arms]),
            np.array([arm.torque for arm in self.arms]),
            contacts,
        )

    def _put_at_rest(self, arms: NDArray[np.intp], q: Floats) -> list[tuple[Contact, ...]]:
        contacts = []
        for arm, row in zip(arms.tolist(), q, strict=True):
            self.arms[arm].reset(row)
            contacts.append(self.arms[arm].contacts())
        return contacts

    def _set_state(self, arm: int, q: Floats, qd: Floats) -> None:
        self.arms[arm].set_state(q, qd)

    def _rebuild(self, arm: int, q: Floats, qd: Floats) -> None:
        self.arms[arm] = self._new_arm()
        self._apply_parameters(arm)
        self.arms[arm].set_state(q, qd)

    def save(self) -> dict[str, Any]:
        return super().save() | self._followers()

    def _followers(self) -> dict[str, Floats]:
        """The state of the joints that follow others (N, 2, F), if the robot has any."""
        if not self.robot.followers:
            return {}
        return {"followers": np.array([arm.followers for arm in self.arms])}

    def restore(self, snapshot: dict[str, Any]) -> None:
        for name, own in self._followers().items():
            check_fits(name, snapshot.get(name), own)
        super().restore(snapshot)
        for index, arm in enumerate(self.arms):
            arm.set_state(self._q[index], self._qd[index])
            if self.robot.followers:
                arm.followers = snapshot["followers"][index]
