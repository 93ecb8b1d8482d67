"""The dynamic backend "mujoco": MuJoCo moves all arms in its own threads, with position servos and contact."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.mujoco.contacts import ContactFinder
from gym_mara.backends.mujoco.model import (
    SHAFT_INERTIA,
    build_model,
    set_parameters,
    without_forces,
)
from gym_mara.backends.mujoco.threads import Stepper, choose_threads
from gym_mara.backends.servo import Motion, ServoBackend
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import Contact
from gym_mara.types import Floats

with needs("the backend 'mujoco'", "mujoco"):
    import mujoco

MOST_MEMORY = 2**33
"""The most memory for the arms, bytes."""
_OF_ENGINE = frozenset(("mass", "effort_limit", "joint_friction", "contact_friction"))
"""The parameters that the engine needs to know; the servos and the sensors take care of the others."""


class MujocoBackend(ServoBackend):
    """Full dynamics by MuJoCo, many arms in its own threads.

    MuJoCo replaces a mesh by its convex hull, and hulls that touch push each other. A contact is reported only where the
    meshes touch, which Coal decides.

    Args:
        robot: the arm.
        num_envs: the number of arms.
        control_period: s.
        physics_step: s; a control period is a whole number of them.
        max_joint_velocity: rad/s (m/s), where it is below the URDF's limits; None for those.
        servo_gain: 1/s.
        on_divergence: what follows when an arm's state diverges: "error", or "truncate" to end the arm's episode.
        threads: how many; the results do not depend on it. None for one on each core, or a single one in a process that
            multiprocessing or Ray has started.
        randomisation: name → (lowest, highest), drawn for each arm at the beginning of each episode; see
            `gym_mara.backends.randomisation`.

    Raises:
        GymMaraError: a setting is out of its range, or MuJoCo cannot load the robot.
    """

    # With random parameters each has a model, of 35 kB for MARA and more with meshes.
    most_arms = 2**16

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        physics_step: float = 0.002,
        max_joint_velocity: float | None = None,
        servo_gain: float = 10.0,
        on_divergence: str = "error",
        threads: int | None = None,
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
        self._settings["threads"] = threads
        self._model = build_model(robot, self.physics_step)
        own_models = bool(_OF_ENGINE & self.randomisation.ranges.keys())
        _check_memory(num_envs, self._model, len(self._times), own_models)
        self._stepper = Stepper(self._model, choose_threads(num_envs, threads))
        self._contact_finder = ContactFinder(robot)
        self._models = [self._model] * num_envs
        if own_models:
            self._models = [copy.copy(self._model) for _ in range(num_envs)]
        self._stills = [without_forces(self._model)] * num_envs
        # MuJoCo's state: time, positions, velocities. Joints come first, the motors' shafts last.
        joints, nq, nv = robot.num_joints, self._model.nq, self._model.nv
        self._joint_q, self._joint_v = slice(1, 1 + joints), slice(1 + nq, 1 + nq + joints)
        self._shaft_q, self._shaft_v = slice(1 + nq - joints, 1 + nq), slice(-joints, None)
        self._v = slice(1 + nq, None)
        followers = [self._model.joint(each.name) for each in robot.followers]
        self._follower_q = [1 + each.qposadr.item() for each in followers]
        self._follower_v = [1 + nq + each.dofadr.item() for each in followers]
        self._states = np.zeros((num_envs, 1 + nq + nv))
        self._warmstarts = np.zeros((num_envs, nv))
        self._effort_limit = np.tile(robot.effort_limit, (num_envs, 1))
        steps = len(self._times) - 1
        self._controls = np.empty((num_envs, steps, joints))
        self._no_controls = np.zeros((num_envs, 1, joints))
        self._no_warmstarts = np.zeros((num_envs, nv))
        self._whole_time = (steps - 0.5) * self.physics_step
        self.reset(np.tile(robot.home, (num_envs, 1)))

    def _run(self, velocities: Floats) -> Motion:
        states, last = self._states, velocities[-1]
        states[:, 0], states[:, self._shaft_q], states[:, self._shaft_v] = 0.0, 0.0, velocities[0]
        self._controls[...] = velocities.swapaxes(0, 1)
        path, during = self._stepper.run(self._models, states, self._warmstarts, self._controls)
        end = path[:, -1].copy()
        # A step finds the contacts at its beginning, so those at the end are still unknown.
        after = self._distances(end)
        contacts: list[tuple[Contact, ...]] = [()] * self.num_envs
        if np.count_nonzero(during) or np.count_nonzero(after):
            distances = np.concatenate([during, after], axis=1)
            contacts = self._contact_finder.find(distances, lambda: self._joint_paths(states, path))
        before = path[:, -2] if len(velocities) > 1 else states
        self._warmstarts = (end[:, self._v] - before[:, self._v]) / self.physics_step
        self._states = end
        qd = end[:, self._joint_v].copy()
        stopped = end[:, 0] < self._whole_time
        if np.count_nonzero(stopped):
            qd[stopped] = np.nan
        torque = (last - end[:, self._shaft_v]) * (SHAFT_INERTIA / self.physics_step)
        # Without the errors of rounding, about 1e-9 Nm.
        torque = np.minimum(np.maximum(torque, -self._effort_limit), self._effort_limit)
        return Motion(end[:, self._joint_q].copy(), qd, torque, contacts)

    def _distances(self, states: Floats) -> Floats:
        """The distance of each of `link_pairs` in n states (n, 1, P), m; negative in contact, else 0."""
        none = self._no_warmstarts[: len(states)], self._no_controls[: len(states)]
        return self._stepper.run(self._stills[: len(states)], states, *none)[1]

    def _joint_paths(self, states: Floats, path: Floats) -> Floats:
        """The joint positions before the first step and after each step (N, K + 1, J)."""
        return np.concatenate([states[:, None], path], axis=1)[..., self._joint_q]

    def _put_at_rest(self, arms: NDArray[np.intp], q: Floats) -> list[tuple[Contact, ...]]:
        for arm, row in zip(arms.tolist(), q, strict=True):
            self._set_state(arm, row, np.zeros_like(row))
        return self._contact_finder.find(self._distances(self._states[arms]), lambda: q[:, None])

    def _rebuild(self, arm: int, q: Floats, qd: Floats) -> None:
        self._set_state(arm, q, qd)

    def _set_state(self, arm: int, q: Floats, qd: Floats) -> None:
        followers, state = self.robot.followers, self._states[arm]
        state[:] = 0.0
        state[self._joint_q], state[self._joint_v] = q, qd
        state[self._follower_q] = [each.position(q) for each in followers]
        state[self._follower_v] = [each.velocity(qd) for each in followers]
        self._warmstarts[arm] = 0.0

    def _set_parameters(self, arm: int, parameters: Mapping[str, Floats]) -> None:
        own = {name: parameters[name] for name in _OF_ENGINE & parameters.keys()}
        if "effort_limit" in own:
            self._effort_limit[arm] = own["effort_limit"] * self.robot.effort_limit
        set_parameters(self._models[arm], self._model, **own)

    def save(self) -> dict[str, Any]:
        """A snapshot, with MuJoCo's state (N, S) and the solver's starting point (N, V) of every arm."""
        engine = {"states": self._states.copy(), "warmstarts": self._warmstarts.copy()}
        return super().save() | engine

    def restore(self, snapshot: dict[str, Any]) -> None:
        for name in ("states", "warmstarts"):
            check_fits(name, snapshot.get(name), getattr(self, f"_{name}"))
        super().restore(snapshot)
        self._states = snapshot["states"].copy()
        self._warmstarts = snapshot["warmstarts"].copy()

    def close(self) -> None:
        self._stepper.stop()


def _check_memory(num_envs: int, model: mujoco.MjModel, steps: int, own_models: bool) -> None:
    """Check that N arms do not take too much memory: the states of a control period, and models of their own."""
    numbers = 1 + model.nq + model.nv + model.nsensordata + model.nu
    size = 8 * steps * numbers + own_models * mujoco.mj_sizeModel(model)
    if num_envs * size > MOST_MEMORY:
        raise GymMaraError(
            f"num_envs must be at most {MOST_MEMORY // size}, because each arm takes {size / 1e6:.2g} MB with {steps - 1} "
            f"physics steps in a control period{' and random parameters' if own_models else ''}; not {num_envs}"
        )
