"""The dynamic backend "mujoco": MuJoCo moves all arms in its own threads, with position servos and contact."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.backends.mujoco.contacts import ContactFinder
from gym_mara.backends.mujoco.model import SHAFT_INERTIA, build_model, set_parameters
from gym_mara.backends.mujoco.threads import Stepper, choose_threads
from gym_mara.backends.servo import Motion, ServoBackend
from gym_mara.robot import RobotModel
from gym_mara.snapshots import check_fits
from gym_mara.state import Contact
from gym_mara.types import Floats

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

    most_arms = 2**16  # with random parameters each has a model, of 35 kB for MARA

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
        self._stepper = Stepper(self._model, choose_threads(num_envs, threads))
        self._contact_finder = ContactFinder(robot)
        self._models = [self._model] * num_envs
        if _OF_ENGINE & self.randomisation.ranges.keys():
            self._models = [copy.copy(self._model) for _ in range(num_envs)]
        # MuJoCo's state: time, positions, velocities. Joints come first, the motors' shafts last.
        joints, nq, nv = robot.num_joints, self._model.nq, self._model.nv
        self._joint_q, self._joint_v = slice(1, 1 + joints), slice(1 + nq, 1 + nq + joints)
        self._shaft_q, self._shaft_v = slice(1 + nq - joints, 1 + nq), slice(-joints, None)
        self._v = slice(1 + nq, None)
        self._states = np.zeros((num_envs, 1 + nq + nv))
        self._warmstarts = np.zeros((num_envs, nv))
        self.reset(np.tile(robot.home, (num_envs, 1)))

    def _run(self, velocities: Floats) -> Motion:
        # Contacts are found at the beginning of a step, so one more shows those at the end of the period.
        commands = np.concatenate([velocities, velocities[-1:]]).swapaxes(0, 1)
        states = self._states
        states[:, 0], states[:, self._shaft_q], states[:, self._shaft_v] = 0.0, 0.0, velocities[0]
        path, distances = self._stepper.run(
            self._models, states, self._warmstarts, np.ascontiguousarray(commands)
        )
        before = np.concatenate([states[:, None, self._joint_q], path[:, :-1, self._joint_q]], 1)
        end, next_ = path[:, -2].copy(), path[:, -1]
        self._warmstarts = (next_[:, self._v] - end[:, self._v]) / self.physics_step
        self._states = end
        qd = end[:, self._joint_v].copy()
        stopped = next_[:, 0] < (len(velocities) + 0.5) * self.physics_step
        qd[stopped] = np.nan
        slip = velocities[-1] - end[:, self._shaft_v]
        return Motion(
            q=end[:, self._joint_q].copy(),
            qd=qd,
            torque=SHAFT_INERTIA / self.physics_step * slip,
            contacts=self._contact_finder.find(before, distances),
        )

    def _put_at_rest(self, arms: NDArray[np.intp], q: Floats) -> list[tuple[Contact, ...]]:
        for arm, row in zip(arms.tolist(), q, strict=True):
            self._set_state(arm, row, np.zeros_like(row))
        models = [self._models[arm] for arm in arms.tolist()]
        none = np.zeros((len(arms), 1, self.robot.num_joints))
        _, distances = self._stepper.run(models, self._states[arms], self._warmstarts[arms], none)
        return self._contact_finder.find(q[:, None], distances)

    def _rebuild(self, arm: int, q: Floats, qd: Floats) -> None:
        self._set_state(arm, q, qd)

    def _set_state(self, arm: int, q: Floats, qd: Floats) -> None:
        followers, state = self.robot.followers, self._states[arm]
        state[:] = 0.0
        after = slice(self._joint_q.stop, self._joint_q.stop + len(followers))
        state[self._joint_q], state[after] = q, [each.position(q) for each in followers]
        after = slice(self._joint_v.stop, self._joint_v.stop + len(followers))
        state[self._joint_v], state[after] = qd, [each.velocity(qd) for each in followers]
        self._warmstarts[arm] = 0.0

    def _set_parameters(self, arm: int, parameters: Mapping[str, Floats]) -> None:
        own = {name: parameters[name] for name in _OF_ENGINE & parameters.keys()}
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
