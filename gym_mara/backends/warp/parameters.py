"""The random physical parameters of N arms, in the model on the device."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np

from gym_mara.backends.mujoco.model import set_parameters
from gym_mara.types import Floats

# What set_parameters changes, and what MuJoCo computes of the masses.
_FIELDS = (
    "body_mass",
    "body_inertia",
    "body_subtreemass",
    "body_invweight0",
    "dof_invweight0",
    "dof_frictionloss",
    "tendon_invweight0",
    "tendon_frictionloss",
    "geom_friction",
)


class ModelParameters:
    """The fields of a model in which arms with random parameters differ, on the host and on the device.

    Args:
        model: MuJoCo's model of the robot.
        num_envs: N.
    """

    batch_sizes: dict[str, int]
    """The number of rows of each field, for `mujoco_warp.put_model`."""

    def __init__(self, model: Any, num_envs: int) -> None:
        self._nominal, self._of_arm = model, copy.copy(model)
        self._fields = {
            name: np.repeat(getattr(model, name)[None].astype(np.float32), num_envs, axis=0)
            for name in _FIELDS
        }
        self.batch_sizes = dict.fromkeys(_FIELDS, num_envs)

    def set(self, arm: int, parameters: Mapping[str, Floats]) -> None:
        """Set those of an arm on the host; see `gym_mara.backends.mujoco.model.set_parameters`."""
        set_parameters(self._of_arm, self._nominal, **parameters)
        for name, values in self._fields.items():
            values[arm] = getattr(self._of_arm, name)

    def copy_to(self, model: Any) -> None:
        """Copy those of all arms to the model on the device."""
        for name, values in self._fields.items():
            getattr(model, name).assign(values)
