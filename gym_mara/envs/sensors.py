"""Sensors: joint encoders whose noise lies between the state and the observation."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from gym_mara.envs.streams import Streams
from gym_mara.errors import GymMaraError, positive_number
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import SimState
from gym_mara.types import Floats, Mask


@dataclasses.dataclass(frozen=True)
class SensorSettings:
    """The settings of the sensors; each is a keyword argument of the environments.

    Raises:
        GymMaraError: a value is out of its range.
    """

    velocity_filter: float = 0.0
    """The time constant of the low-pass filter for measured velocities, s; 0 for no filter."""

    def __post_init__(self) -> None:
        filtered = positive_number("velocity_filter", self.velocity_filter, "s", or_zero=True)
        object.__setattr__(self, "velocity_filter", filtered)


def noise_of(state: SimState) -> Floats | None:
    """The standard deviation of each arm's measured joint positions (N,), rad; None without sensor noise."""
    return None if state.parameters is None else state.parameters.get("sensor_noise")


class Sensors:
    """The encoders of N arms: positions with Gaussian noise, and velocities as finite differences of these.

    Measured values are clipped to the joint limits. The pose and the velocity of the end effector are computed from the
    measured joint values. The first measurement of an episode has velocity zero.

    Args:
        robot: the arm.
        num_envs: N.
        period: the time between two measurements, s.
        joint_velocity: the largest speed of each joint (J,), rad/s.
        settings: the settings of the sensors.
    """

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        period: float,
        joint_velocity: Floats,
        settings: SensorSettings,
    ) -> None:
        self._robot, self._period, self._joint_velocity = robot, period, joint_velocity
        self._kinematics = robot.kinematics()
        # An exponential filter in discrete time, with period T: v += (1 - e^(-T/τ)) (difference/T - v).
        filtered = settings.velocity_filter
        self._weight = 1.0 - np.exp(-period / filtered) if filtered else 1.0
        self._q = np.zeros((num_envs, robot.num_joints))
        self._qd = np.zeros_like(self._q)
        # The noise of each arm's episode. A new episode has a new generator, so that it does not depend on how many steps
        # the last one had: a vector environment also steps arms whose episodes have ended.
        self._generators: dict[int, np.random.Generator] = {}

    @property
    def q(self) -> Floats:
        """The last measured joint positions (N, J), rad."""
        return self._q.copy()

    def begin_episodes(self, streams: Sequence[Streams], arms: Mask) -> None:
        """Seed the noise of the chosen arms (N,) from their random generators."""
        for arm in np.flatnonzero(arms).tolist():
            self._generators[arm] = np.random.default_rng(streams[arm].sensors.integers(2**63))

    def begin(self, q: Floats, noise: Floats, arms: Mask) -> None:
        """Take the first measurement of the chosen arms, which are at rest.

        Args:
            q: the joint positions (N, J), rad; only the rows of the chosen arms are used.
            noise: the standard deviation of each arm's measured positions (N,), rad.
            arms: the chosen arms (N,).
        """
        self._q[arms] = self._positions(q, noise, arms)[arms]
        self._qd[arms] = 0.0

    def measure(self, q: Floats, noise: Floats) -> None:
        """Measure all arms, one period after their last measurement. The arguments are as in `begin`."""
        measured = self._positions(q, noise, np.ones(len(q), np.bool_))
        self._qd += self._weight * ((measured - self._q) / self._period - self._qd)
        self._q = measured

    def seen(self, state: SimState) -> SimState:
        """Replace the joint and end-effector values of a state with the last measurements."""
        q = self._q.copy()
        qd = self._qd.clip(-self._joint_velocity, self._joint_velocity)
        position, quaternion = self._kinematics.pose(q)
        return dataclasses.replace(
            state,
            q=q,
            qd=qd,
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=self._kinematics.velocity(q, qd),
        )

    def _positions(self, q: Floats, noise: Floats, arms: Mask) -> Floats:
        measured = q.copy()
        for arm, generator in self._generators.items():  # the others have not begun an episode yet
            if arms[arm]:
                measured[arm] += noise[arm] * generator.standard_normal(q.shape[1])
        return measured.clip(self._robot.lower, self._robot.upper)

    def save(self) -> dict[str, Any]:
        """A snapshot of the last measurements and of the noise."""
        return copy.deepcopy({"q": self._q, "qd": self._qd, "generators": self._generators})

    def check(self, snapshot: Any) -> None:
        """Check that a snapshot is one of sensors like these.

        Raises:
            GymMaraError: it is not.
        """
        check_fits("sensors", snapshot, self.save() | {"generators": dict})
        arms = snapshot["generators"].keys() & range(len(self._q))
        form = dict.fromkeys(arms, np.random.Generator)
        check_fits("generators", snapshot["generators"], form)

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Restore a snapshot."""
        snapshot = copy.deepcopy(snapshot)
        self._q, self._qd = snapshot["q"], snapshot["qd"]
        self._generators = snapshot["generators"]


def check_noise(settings: SensorSettings, noise: Floats | None, *, tensors: bool) -> None:
    """Check that the settings and the arrays of a backend fit its noise, from `noise_of`.

    Raises:
        GymMaraError: they do not.
    """
    if tensors and noise is not None:
        raise GymMaraError(
            "the sensors' noise is drawn on the host: leave out randomisation={'sensor_noise': …}, or choose arrays='numpy'"
        )
    if settings.velocity_filter and noise is None:
        raise GymMaraError(
            "velocity_filter smooths the velocity of noisy sensors, and these are exact: on a backend that has "
            "'randomisation' also give randomisation={'sensor_noise': (lowest, highest)}; else leave it out"
        )
