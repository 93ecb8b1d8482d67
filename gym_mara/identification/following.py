"""Follows a log with many arms at once, each with its own parameters, on all cores."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np
import pinocchio as pin

from gym_mara.backends import backend_settings, make_backend
from gym_mara.backends.processes import Workers, cores
from gym_mara.backends.registry import backend_class
from gym_mara.backends.servo import ServoBackend
from gym_mara.backends.workers import choose_workers
from gym_mara.errors import GymMaraError
from gym_mara.identification.log import Log
from gym_mara.identification.parameters import Space
from gym_mara.robot import RobotModel
from gym_mara.types import Floats

_MOST_WORKERS = 16
"""More processes would have only one arm each, or none."""


class Follower:
    """A backend whose arms are told the targets of a log, from measured states.

    The arms have no shapes: the arm of the log is taken to touch nothing.

    Args:
        log: what happened.
        robot: the arm.
        backend: the name of a backend with dynamics.
        space: the parameters.
        settings: keyword arguments of the backend.

    Raises:
        GymMaraError: the backend does not have these parameters, or a setting is wrong.
        MissingExtraError: its engine is not installed.
    """

    def __init__(
        self, log: Log, robot: RobotModel, backend: str, space: Space, settings: dict[str, Any]
    ) -> None:
        kind = backend_class(backend)
        if not issubclass(kind, ServoBackend):
            raise GymMaraError(
                f"the backend {backend!r} has no parameters that can be identified: use dart or mujoco"
            )
        for name in ("control_period", "randomisation", "on_divergence", "workers"):
            if name in settings:
                raise GymMaraError(f"{name} is given by the log and the parameters: leave it out")
        self._log, self._space, self._backend = log, space, backend
        self._robot = without_shapes(robot)
        self._settings: dict[str, Any] = {
            **settings,
            "control_period": log.control_period,
            "on_divergence": "truncate",
            "randomisation": space.ranges,
        }
        if kind.in_processes:
            self._settings["workers"] = 1
        elif "threads" in backend_settings(backend):
            self._settings.setdefault("threads", 1)
        self._arms: dict[int, ServoBackend] = {}

    def starts(self, segment: float) -> range:
        """The ticks at which arms that follow in segments of this length, s, start from a measured state."""
        length = round(min(segment, self._log.duration + 1.0) / self._log.control_period)
        return range(0, len(self._log.times) - 1, max(1, length))

    def errors(self, vectors: Floats, segment: float = math.inf) -> Floats:
        """How far arms with these parameter vectors (M, P) are from the log, at all ticks but the first (M, T - 1, J), rad (m).

        Args:
            vectors: the parameters of each arm.
            segment: after this time, s, the arms start again from the measured state. Its noise, above all that of the
                velocity, is then an error of the arms; but they never are far from the log, whatever their parameters.
        """
        log, starts = self._log, self.starts(segment)
        if not len(vectors):
            return np.empty((0, len(log.times) - 1, log.q.shape[1]))
        arms = self.arms(len(vectors))
        arms.set_parameters(self._space.values(vectors))
        path = np.empty((len(log.times) - 1, len(vectors), log.q.shape[1]))
        for tick, target in enumerate(log.targets[:-1]):
            if tick in starts:
                arms.continue_from(log.q[tick], log.qd[tick], log.targets[: max(tick, 1)])
            path[tick] = arms.step(np.broadcast_to(target, path.shape[1:])).q
        return path.swapaxes(0, 1) - log.q[1:]

    def arms(self, count: int) -> ServoBackend:
        """The backend with this many arms, made when it is first needed."""
        if count not in self._arms:
            made = make_backend(self._backend, self._robot, count, self._settings)
            assert isinstance(made, ServoBackend)
            self._arms[count] = made
        return self._arms[count]

    def close(self) -> None:
        """Free the engines."""
        for arms in self._arms.values():
            arms.close()


class Followers:
    """Followers of the same log in processes, one for each core, which share the arms.

    Args:
        log, robot, backend, space, settings: as in `Follower`.

    Raises:
        GymMaraError, MissingExtraError: as in `Follower`.
    """

    def __init__(
        self, log: Log, robot: RobotModel, backend: str, space: Space, settings: dict[str, Any]
    ) -> None:
        make = functools.partial(Follower, log, robot, backend, space, settings)
        own = make()  # checks the settings before a process is started
        arms = own.arms(1)
        self.servo_gain, self.joint_velocity = arms.servo_gain or 1.0, arms.joint_velocity
        """The servo gain, 1/s, and the limits of velocity (J,), rad/s (m/s), of the backend."""
        self.physics_step = arms.physics_step
        """Of the backend, s."""
        self.starts = own.starts
        self._own = own
        self._count = choose_workers(min(len(cores()), _MOST_WORKERS), None)
        self._workers = Workers(make, self._count) if self._count > 1 else None

    def errors(self, vectors: Floats, segment: float = math.inf) -> Floats:
        """As of a `Follower`, whatever the number of processes."""
        if self._workers is None or len(vectors) == 1:
            return self._own.errors(vectors, segment)
        parts = [part for part in np.array_split(vectors, self._count) if len(part)]
        parts += [vectors[:0]] * (self._count - len(parts))
        return np.concatenate(self._workers.call("errors", [(part, segment) for part in parts]))

    def close(self) -> None:
        """End the processes, and free the engines."""
        if self._workers is not None:
            self._workers.close()
        self._own.close()


def without_shapes(robot: RobotModel) -> RobotModel:
    """The same arm with nothing that can touch."""
    return dataclasses.replace(
        robot,
        geometry=pin.GeometryModel(),
        shapes=(),
        collision_pairs=frozenset(),
        excluded_pairs={},
    )
