"""A backend of tensors on the CPU, to test tasks and environments without a GPU: PinocchioBackend, whose states are converted."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from gym_mara.arrays import host
from gym_mara.backends.pinocchio import PinocchioBackend
from gym_mara.robot import RobotModel
from gym_mara.state import SimState
from gym_mara.types import Array, Floats, Mask


class TensorBackend(PinocchioBackend):
    """The same numbers in three forms: NumPy's arrays, and tensors of float64 or float32.

    Args:
        arrays: "numpy" or "torch".
        dtype: "float64" or "float32".
        noise: the standard deviation of the sensors' noise, rad; None for exact sensors.
        random_mass: whether a parameter "mass" is drawn for each episode; no joint feels it.
        diverges_beyond: the angle of the first joint beyond which an arm counts as diverged, rad.
    """

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        arrays: str = "torch",
        dtype: str = "float64",
        noise: float | None = None,
        random_mass: bool = False,
        diverges_beyond: float | None = None,
        max_joint_velocity: float | None = None,
    ) -> None:
        super().__init__(robot, num_envs, max_joint_velocity=max_joint_velocity)
        self.arrays, self._dtype = arrays, getattr(torch, dtype)
        self.device = None if arrays == "numpy" else "cpu"
        self.random, self._diverges_beyond = random_mass, diverges_beyond
        self._parameters: dict[str, Floats] = {}
        if noise is not None:
            self._parameters["sensor_noise"] = np.full(num_envs, noise)
        if random_mass:
            self._parameters["mass"] = np.ones(num_envs)

    def asarray(self, values: ArrayLike) -> Array:
        array = super().asarray(values)
        if self.arrays == "numpy":
            return array
        return torch.tensor(array, dtype=None if array.dtype == np.bool_ else self._dtype)

    def begin_episodes(self, seeds: NDArray[np.uint64], mask: Mask) -> None:
        for arm in np.flatnonzero(mask):
            self._parameters["mass"][arm] = np.random.default_rng(seeds[arm]).uniform(0.5, 1.5)

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        super().reset(host(q).astype(np.float64), None if mask is None else host(mask))

    def step(self, q_target: Floats) -> SimState:
        return super().step(host(q_target).astype(np.float64))

    @property
    def state(self) -> SimState:
        state = super().state
        if self._diverges_beyond is not None:
            state = dataclasses.replace(state, diverged=state.q[:, 0] > self._diverges_beyond)
        if self._parameters:
            state = dataclasses.replace(
                state, parameters={k: v.copy() for k, v in self._parameters.items()}
            )
        fields = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
        return SimState(**{name: self._converted(value) for name, value in fields.items()})

    def _converted(self, value: Any) -> Any:
        if isinstance(value, dict):
            return {name: self.asarray(array) for name, array in value.items()}
        return None if value is None else self.asarray(value)
