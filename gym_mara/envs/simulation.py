"""Simulation: joins a robot, a backend and a task, for N arms. The environments are its two faces."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from gym_mara import rotations
from gym_mara.backends import backend_settings, make_backend
from gym_mara.collision.coal import touching_links
from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.errors import GymMaraError, whole_number
from gym_mara.robot import RobotLike, RobotModel
from gym_mara.robot.inverse_kinematics import FreePoses
from gym_mara.state import SimState, View
from gym_mara.tasks import Goal, Task, make_task

Floats = NDArray[np.float64]
Mask = NDArray[np.bool_]
Generators = Sequence[np.random.Generator]


class Outcome(NamedTuple):
    """What one step brought, per arm."""

    observation: Floats
    """(N, O); where an arm collided, of the colliding pose."""
    reward: Floats
    """(N,)."""
    terminated: Mask
    """(N,)."""
    truncated: Mask | None
    """The arms (N,) whose simulation broke down, if any."""
    info: dict[str, NDArray[Any]]
    """The task's reward terms, `collided`, each (N,), and what the backend reports, (N, …)."""


class Simulation:
    """N arms of one robot, moved by one backend, judged by one task.

    Args:
        task: the name of a task, or a task.
        num_envs: N.
        robot: a robot's name, the path of a URDF, a list of MARA's modules, or a RobotModel.
        ee_frame: the end-effector link of a URDF of your own.
        backend: the name of a backend.
        options: values of the task and settings of the backend, by keyword.
        others: what else is a keyword argument where these come from; an error about an unknown one names them too.

    Raises:
        GymMaraError: a name is unknown, or a value is out of its range.
        MissingExtraError: a library is not installed.
    """

    def __init__(
        self,
        task: str | Task,
        num_envs: int,
        robot: RobotLike,
        ee_frame: str | None,
        backend: str,
        options: dict[str, Any],
        others: Sequence[str] = (),
    ) -> None:
        self.num_envs = whole_number("num_envs", num_envs)
        self.task, self._settings = make_task(task, options)
        self.robot = RobotModel.load(robot, ee_frame)
        known = [*(field.name for field in dataclasses.fields(self.task)), *others]
        self.backend = make_backend(backend, self.robot, self.num_envs, self._settings, known)
        self.backend_name = backend
        self.random = self.backend.random or self.task.random_goal
        """Whether episodes differ, so that `reset` wants generators."""
        self._poses = FreePoses(self.robot) if self.task.random_goal else None
        self.goal = self.task.goal(self.robot, self.num_envs)
        start = self.robot.home if self.task.start_q is None else self.task.start_q
        self._start = np.tile(self.robot.checked_q(start, "start_q"), (self.num_envs, 1))
        self._started = False
        self._closed = False
        # What the last step's observations are of; and the arms that have begun an episode since.
        self._seen: SimState | None = None
        self._began = np.zeros(self.num_envs, np.bool_)
        self.statistics = EpisodeStatistics(self.num_envs)
        self._kinematics = self.robot.kinematics()
        # The sensors' noise, from a generator for each arm's episode.
        self._noise: dict[int, np.random.Generator] = {}
        self.observation_space = self.task.observation_space(
            self.robot, self.goal, self.backend.joint_velocity
        )
        self.action_space = Box(-np.pi, np.pi, (self.robot.num_joints,), np.float32)
        # The joint targets that can come about: within the action space and the joint limits, rad.
        self.target_low = np.maximum(self.action_space.low.astype(np.float64), self.robot.lower)
        self.target_high = np.minimum(self.action_space.high.astype(np.float64), self.robot.upper)

    def reset(self, generators: Generators, mask: Mask | None = None) -> Floats:
        """Begin new episodes, of all arms or of those that the mask (N,) names; the observations (N, O) then.

        Args:
            generators: each arm's source of randomness, N of them.
            mask: the arms.
        """
        self._check_open()
        chosen = np.ones(self.num_envs, np.bool_) if mask is None else mask
        if self.backend.random:
            seeds = np.zeros(self.num_envs, np.uint64)
            for index in np.flatnonzero(chosen).tolist():
                seeds[index] = generators[index].integers(2**63)
                self._noise[index] = np.random.default_rng(seeds[index])
            self.backend.begin_episodes(seeds, chosen)
        if self._poses is not None:
            position, quaternion = self.goal.position.copy(), self.goal.quaternion.copy()
            for index in np.flatnonzero(chosen).tolist():
                drawn = self.task.draw_goal(self._poses, generators[index])
                position[index], quaternion[index] = drawn
            self.goal = Goal(position, quaternion)
        self.backend.reset(self._start, mask)
        self.statistics.clear(slice(None) if mask is None else mask)
        self._started = True
        self._began[chosen] = True
        return self._observe(self.backend.state, chosen)

    def step(self, action: ArrayLike) -> Outcome:
        """Move every arm for one control period towards its joint targets (N, J), rad.

        Raises:
            GymMaraError: the action has the wrong shape or is not finite; nothing has moved then.
            ResetNeeded, ClosedEnvironmentError: the environment was not reset, or is closed.
        """
        self._check_open()
        if not self._started:
            raise ResetNeeded("call reset() before the first step()")
        state = self.backend.step(self._target(action))
        self._seen = state
        self._began.fill(False)
        observation = self._observe(state)
        reward, info = self.task.reward(state, self.goal)
        terminated = self.task.terminated(state, self.goal)
        collided = state.collided
        if self.task.on_collision == "terminate":
            terminated = terminated | collided
        elif self.task.on_collision == "reset" and (count := np.count_nonzero(collided)):
            self.backend.reset(self._start, None if count == self.num_envs else collided)
        distance = info["distance"] if "distance" in info else np.full(self.num_envs, np.nan)
        self.statistics.add(distance, reward, collided)
        diverged = None if state.diverged is None or not state.diverged.any() else state.diverged
        everything = {**info, "collided": collided, **report(state)}
        return Outcome(observation, reward, terminated, diverged, everything)

    def view(self, arm: int) -> View:
        """How an arm looks in its last observation: where it collided and was put back, it still collides there."""
        self._check_open()
        state = self.backend.state if self._seen is None or self._began[arm] else self._seen
        touching: frozenset[str] = frozenset()
        if state.collided[arm]:
            contacts = () if state.contacts is None else state.contacts[arm]
            links = frozenset(link for contact in contacts for link in contact.links)
            touching = links or touching_links(self.robot, state.q[arm])
        return View(state.q[arm], self.goal.position[arm], self.goal.quaternion[arm], touching)

    def set_goal(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Move the goal of every arm to a position (3,), m, and a unit quaternion (4,), [w, x, y, z]."""
        quaternion = rotations.normalised(np.asarray(quaternion, np.float64))
        quaternion = rotations.canonical(quaternion)
        shape = (self.num_envs, 1)
        self.goal = Goal(
            np.tile(np.asarray(position, np.float64), shape), np.tile(quaternion, shape)
        )

    def switch_backend(self, name: str) -> None:
        """Go on in another backend, at rest where the joints are; it keeps those settings that it knows.

        Raises:
            GymMaraError: the name is unknown.
            MissingExtraError: the backend's engine is not installed.
        """
        self._check_open()
        known = backend_settings(name)
        settings = {key: value for key, value in self._settings.items() if key in known}
        backend = make_backend(name, self.robot, self.num_envs, settings)
        if backend.random:
            seeds = np.random.default_rng().integers(2**63, size=self.num_envs, dtype=np.uint64)
            backend.begin_episodes(seeds, np.ones(self.num_envs, np.bool_))
        backend.reset(self.backend.state.q.clip(self.robot.lower, self.robot.upper))
        self.backend.close()
        self.backend, self.backend_name, self._seen = backend, name, None

    def _observe(self, state: SimState, chosen: Mask | None = None) -> Floats:
        """What the task shows of the states, as the sensors of the arms, or of those chosen, see them."""
        noise = (state.parameters or {}).get("sensor_noise")
        if noise is not None:
            q = state.q.copy()
            for index, generator in self._noise.items():
                if chosen is None or chosen[index]:
                    q[index] += noise[index] * generator.standard_normal(q.shape[1])
            q = q.clip(self.robot.lower, self.robot.upper)
            position, quaternion = self._kinematics.pose(q)
            state = dataclasses.replace(state, q=q, ee_position=position, ee_quaternion=quaternion)
        return self.task.observe(state, self.goal)

    def _target(self, action: ArrayLike) -> Floats:
        """The joint targets that an action asks for, clipped to the action space and the joint limits."""
        try:
            target = np.asarray(action, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise GymMaraError(f"an action must be an array of numbers: {error}") from error
        if target.shape != self._start.shape:
            raise GymMaraError(
                f"the action has shape {target.shape[1:] if self.num_envs == 1 else target.shape}; "
                f"{self.robot.name} wants {self._start.shape[1:] if self.num_envs == 1 else self._start.shape}"
            )
        if np.count_nonzero(np.isfinite(target)) < target.size:
            raise GymMaraError(
                "the action holds NaN or infinity; joint targets must be finite (rad)"
            )
        return target.clip(self.target_low, self.target_high)

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedEnvironmentError("the environment is closed; make a new one")

    def save(self) -> dict[str, Any]:
        """A snapshot of the arms and of the episodes' statistics."""
        return {
            "backend": self.backend.save(),
            "statistics": copy.deepcopy(self.statistics),
            "noise": copy.deepcopy(self._noise),
            "started": self._started,
            "goal": (self.goal.position, self.goal.quaternion),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go back to a snapshot."""
        self._check_open()
        self.backend.restore(snapshot["backend"])
        self.statistics = copy.deepcopy(snapshot["statistics"])
        self._noise = copy.deepcopy(snapshot["noise"])
        self._started = snapshot["started"]
        self._seen = None
        self.goal = Goal(*(values.copy() for values in snapshot["goal"]))

    def close(self) -> None:
        """Free the backend; closing twice does no harm."""
        if not self._closed:
            self._closed = True
            self.backend.close()


def report(state: SimState) -> dict[str, NDArray[Any]]:
    """What `info` says of the arms beyond the task's terms, each (N, …)."""
    values: dict[str, NDArray[Any]] = {}
    if state.torque is not None:
        values["joint_torque"] = state.torque
    if state.contacts is not None:
        values["contacts"] = np.empty(len(state.contacts), dtype=object)
        for arm, contacts in enumerate(state.contacts):
            values["contacts"][arm] = [contact._asdict() for contact in contacts]
    return values | dict(state.parameters or {})
