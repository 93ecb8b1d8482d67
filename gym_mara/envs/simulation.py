"""Simulation: N arms of one robot, moved by one backend, judged by one task."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Space
from numpy.typing import ArrayLike, NDArray

from gym_mara import rotations
from gym_mara.arrays import host, namespace, zeros_like
from gym_mara.backends import backend_settings, make_backend
from gym_mara.envs.actions import action_space, joint_targets, tensor_targets
from gym_mara.envs.options import Options
from gym_mara.envs.sensors import Sensors
from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.envs.streams import Streams
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError, finite_numbers, whole_number
from gym_mara.snapshots import check_fits
from gym_mara.state import SimState
from gym_mara.tasks import Goal, Observation
from gym_mara.types import Array, Floats, Mask


class Outcome(NamedTuple):
    """The result of one step, per arm, in the backend's arrays."""

    observation: Floats
    """The observations (N, O); for an arm that collided, from its colliding configuration."""
    reward: Floats
    """The rewards (N,)."""
    terminated: Mask
    """Whether the episode terminated (N,)."""
    truncated: Mask | None
    """Whether the arm's state diverged (N,); None if no arm's did."""
    info: dict[str, NDArray[Any]]
    """The task's reward terms and `collided`, each (N,); torques, contacts and random parameters, each (N, …), if the
    state has them."""
    state: SimState
    """The state that the task rewarded; for an arm that collided, its colliding configuration."""


class Simulation:
    """N arms of one robot, moved by one backend, judged by one task.

    Actions, observations and all other arrays are the backend's (`Backend.arrays`): those of NumPy, or tensors, which no step
    copies from or to the host. `observation_space`, `action_space`, `target_low`, `target_high` and snapshots are NumPy's.

    Args:
        options: the task, the robot, the backend and their settings.
        num_envs: N.

    Raises:
        GymMaraError: a value is out of its range.
        MissingExtraError: a library is not installed.
    """

    def __init__(self, options: Options, num_envs: int) -> None:
        self.num_envs = whole_number("num_envs", num_envs)
        self.task, self.robot = options.task, options.robot
        self.options = options
        self.backend_name = options.backend
        self.backend = make_backend(options.backend, self.robot, self.num_envs, options.settings)
        self._workspace = RobotWorkspace(self.robot)
        asarray = self.backend.asarray
        goal = self.task.goal(self.robot, self._workspace, self.num_envs)
        self.goal = Goal(asarray(goal.position), asarray(goal.quaternion))
        start = self.robot.home if self.task.start_q is None else self.task.start_q
        self._start = asarray(np.tile(self.robot.checked_q(start, "start_q"), (self.num_envs, 1)))
        # A tensor of the backend's type and device; None with NumPy's arrays.
        self._tensor = None if self.backend.arrays == "numpy" else self._start
        self._started = False
        self._closed = False
        self.outcome: Outcome | None = None
        """The outcome of the last step."""
        # The arms that began an episode after the last step.
        self._began = asarray(np.zeros(self.num_envs, np.bool_))
        self.statistics = EpisodeStatistics(self.num_envs, self._tensor)
        self.streams: Sequence[Streams] = ()
        """The random generators of each arm; needed if `random` is true."""
        if self._tensor is not None and _sensor_noise(self.backend.state) is not None:
            raise GymMaraError(
                "the sensors' noise is drawn on the host: leave out randomisation={'sensor_noise': …}, or choose arrays='numpy'"
            )
        if options.sensors.velocity_filter and _sensor_noise(self.backend.state) is None:
            raise GymMaraError(
                "velocity_filter smooths the velocity of noisy sensors, and these are exact: on a backend that has "
                "'randomisation' also give randomisation={'sensor_noise': (lowest, highest)}; else leave it out"
            )
        self._sensors = self._new_sensors()
        self.observation = Observation(
            self.task.observation(self.robot, goal, self.backend.joint_velocity),
            self.backend.overshoot,
        )
        overshoot = self.backend.overshoot
        self._observed_range = (
            asarray(self.robot.lower - overshoot),
            asarray(self.robot.upper + overshoot),
        )
        self.observation_space: Space[Any] = self.observation.space
        """The space of one arm's observation in the form of `present`."""
        self.action_space = action_space(self.robot)
        # The range of joint targets: the intersection of the action space and the joint limits, rad (m).
        self.target_low = np.maximum(self.action_space.low.astype(np.float64), self.robot.lower)
        self.target_high = np.minimum(self.action_space.high.astype(np.float64), self.robot.upper)
        self._target_range = asarray(self.target_low), asarray(self.target_high)

    @property
    def random(self) -> bool:
        """Whether episodes have random parameters or goals, so that `reset` needs `streams`."""
        return self.backend.random or self.task.random_goal

    def reset(self, mask: Mask | None = None) -> tuple[Floats, dict[str, NDArray[Any]]]:
        """Begin new episodes of all arms, or of the arms that the mask (N,) selects.

        Returns:
            The observations (N, O); and torques, contacts and random parameters, each (N, …), if the state has them.
        """
        self._check_open()
        if self.random:
            self._draw(np.ones(self.num_envs, np.bool_) if mask is None else host(mask))
        self.backend.reset(self._start, mask)
        chosen = slice(None) if mask is None else mask
        self.statistics.clear(chosen)
        self._started = True
        self._began[chosen] = True
        state = self.backend.state
        noise = _sensor_noise(state)
        if noise is not None:
            arms = np.ones(self.num_envs, np.bool_) if mask is None else mask
            self._sensors.begin_episodes(self.streams, arms)
            self._sensors.begin(self._start, noise, arms)
        return self._observe(state, noise), _report(state)

    def _draw(self, chosen: Mask) -> None:
        """Draw the random parameters and goals of new episodes; the mask (N,) is NumPy's, because each arm has its generators."""
        arms = np.flatnonzero(chosen).tolist()
        if self.backend.random:
            seeds = np.zeros(self.num_envs, np.uint64)
            for index in arms:
                seeds[index] = self.streams[index].parameters.integers(2**63)
            self.backend.begin_episodes(seeds, chosen)
        if self.task.random_goal:
            position, quaternion = np.zeros((self.num_envs, 3)), np.zeros((self.num_envs, 4))
            for index in arms:
                drawn = self.task.draw_goal(self._workspace, self.streams[index].goals)
                position[index], quaternion[index] = drawn
            asarray, old = self.backend.asarray, self.goal
            xp, rows = namespace(old.position), asarray(chosen)[:, None]
            self.goal = Goal(
                xp.where(rows, asarray(position), old.position),
                xp.where(rows, asarray(quaternion), old.quaternion),
            )

    def step(self, action: ArrayLike) -> Outcome:
        """Move every arm towards its joint targets (N, J), rad, for one control period.

        Raises:
            GymMaraError: the action has the wrong type or shape, or is not finite. No arm moves then.
            ResetNeeded: the environment was not reset.
            ClosedEnvironmentError: the environment is closed.
        """
        self._check_open()
        if not self._started:
            raise ResetNeeded("call reset() before the first step()")
        xp = namespace(self._start)
        state = self.backend.step(self._target(action, xp))
        self._began[...] = False
        noise = _sensor_noise(state)
        if noise is not None:
            self._sensors.measure(state.q, noise)
        observation = self._observe(state, noise)
        reward, terms = self._reward(state, observation)
        terminated = self.task.terminated(state, self.goal)
        collided = state.collided
        if self.task.on_collision == "terminate":
            terminated = terminated | collided
        elif self.task.on_collision == "reset" and (count := xp.count_nonzero(collided)):
            self.backend.reset(self._start, None if count == self.num_envs else collided)
            if noise is not None:
                self._sensors.begin(self._start, noise, collided)
        distance = terms["distance"] if "distance" in terms else zeros_like(reward) + np.nan
        self.statistics.add(distance, reward, collided)
        diverged = state.diverged
        truncated = diverged if diverged is not None and xp.count_nonzero(diverged) else None
        info = {**terms, "collided": collided, **_report(state)}
        self.outcome = Outcome(observation, reward, terminated, truncated, info, state)
        return self.outcome

    def rewards(self, state: SimState) -> tuple[Floats, dict[str, NDArray[Any]]]:
        """The rewards (N,) of a state without sensor noise, and their terms."""
        return self._reward(state, self._observe(state, None))

    def _reward(
        self, state: SimState, observation: Floats
    ) -> tuple[Floats, dict[str, NDArray[Any]]]:
        """The rewards (N,) of a state with its observations (N, O), and their terms."""
        return self.task.reward(state, self.goal)

    def present(self, flat: Floats) -> Any:
        """Flat observations (…, O) in the form of the observation space."""
        return flat

    def observed(self, arm: int) -> SimState:
        """The state of an arm's last observation: after a collision, the colliding state, even if the arm was reset."""
        self._check_open()
        if self.outcome is None or self._began[arm]:
            return self.backend.state
        return self.outcome.state

    def set_goal(self, position: ArrayLike, quaternion: ArrayLike) -> None:
        """Set the goal of every arm to a position (3,), m, and a quaternion (4,), [w, x, y, z], which is normalised.

        Raises:
            GymMaraError: a value has another shape or is not finite, or the quaternion is zero. The goal stays then.
        """
        point = finite_numbers("position", position, 3)
        turn = np.array(finite_numbers("quaternion", quaternion, 4))
        if not np.linalg.norm(turn) > 1e-6:
            raise GymMaraError(f"a quaternion must not be zero, as {turn.tolist()} is")
        turn = rotations.canonical(rotations.normalised(turn))
        asarray, shape = self.backend.asarray, (self.num_envs, 1)
        self.goal = Goal(asarray(np.tile(point, shape)), asarray(np.tile(turn, shape)))

    def switch_backend(self, name: str) -> None:
        """Continue in another backend, at rest at the current joint positions.

        The new backend receives those of the user's settings that it knows.

        Raises:
            GymMaraError: the name is unknown.
            MissingExtraError: the backend's engine is not installed.
        """
        self._check_open()
        known = backend_settings(name)
        settings = {key: v for key, v in self.options.settings.items() if key in known}
        backend = make_backend(name, self.robot, self.num_envs, settings)
        if (backend.arrays, self.backend.arrays) != ("numpy", "numpy"):
            backend.close()
            raise GymMaraError(
                "a simulation of tensors stays in its backend; make a new environment"
            )
        everyone = np.ones(self.num_envs, np.bool_)
        if backend.random:
            if not self._started:
                raise ResetNeeded("call reset() before you switch the backend")
            seeds = [stream.backends.integers(2**63) for stream in self.streams]
            backend.begin_episodes(np.array(seeds, np.uint64), everyone)
        q = self.backend.state.q.clip(self.robot.lower, self.robot.upper)
        backend.reset(q)
        self.backend.close()
        self.backend, self.backend_name, self.outcome = backend, name, None
        self._sensors = self._new_sensors()
        noise = _sensor_noise(backend.state)
        if noise is not None:
            self._sensors.begin_episodes(self.streams, everyone)
            self._sensors.begin(q, noise, everyone)

    def _new_sensors(self) -> Sensors:
        backend = self.backend
        return Sensors(
            self.robot,
            self.num_envs,
            backend.control_period,
            backend.joint_velocity,
            self.options.sensors,
        )

    def _observe(self, state: SimState, noise: Floats | None) -> Floats:
        """The observations (N, O) of a state; if there is noise, of what the sensors have measured."""
        if noise is not None:
            state = self._sensors.seen(state)
        if self.backend.overshoot:
            # An impact may take a joint further, but the observation stays in its space.
            low, high = self._observed_range
            xp = namespace(low)
            state = state.with_q(xp.minimum(xp.maximum(state.q, low), high))
        return self.observation(state, self.goal)

    def _target(self, action: ArrayLike, xp: Any) -> Floats:
        """The joint targets of an action, clipped to the range of joint targets."""
        if self._tensor is None:
            target: Array = joint_targets(action).astype(np.float64, copy=False)
        else:
            target = tensor_targets(action, self._tensor)
        needed = self._start.shape
        if target.shape != needed:
            own = slice(1 if self.num_envs == 1 else 0, None)
            raise GymMaraError(
                f"the action has shape {(*target.shape,)[own]}; {self.robot.name} needs {(*needed,)[own]}"
            )
        if xp.count_nonzero(xp.isfinite(target)) < needed[0] * needed[1]:
            raise GymMaraError(
                "the action contains NaN or infinity; joint targets must be finite (rad)"
            )
        # In half the time of target.clip for one arm.
        low, high = self._target_range
        return xp.minimum(xp.maximum(target, low), high)

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedEnvironmentError("the environment is closed; make a new one")

    def save(self) -> dict[str, Any]:
        """A snapshot of the arms, the sensors, the random generators, the goals and the statistics of the episodes."""
        return {
            "made_with": self._made_with(),
            "backend": self.backend.save(),
            "statistics": self.statistics.copy(),
            "sensors": self._sensors.save(),
            "streams": copy.deepcopy(self.streams),
            "started": self._started,
            "goal": self._host_goal(),
        }

    def _host_goal(self) -> tuple[Floats, Floats]:
        return host(self.goal.position), host(self.goal.quaternion)

    def check_snapshot(self, snapshot: Any, others: dict[str, Any]) -> None:
        """Check that a snapshot fits this simulation, except for what the backend checks itself.

        Args:
            snapshot: the snapshot of an environment.
            others: examples of the values that the environment has added to those of `save`.

        Raises:
            GymMaraError: it does not.
            ClosedEnvironmentError: the environment is closed.
        """
        self._check_open()
        made_with = snapshot.get("made_with") if isinstance(snapshot, dict) else None
        if made_with != self._made_with():
            raise GymMaraError(
                f"the snapshot is of (robot, backend, arms) {made_with}, and this environment is {self._made_with()}: "
                "restore only what an environment with the same arguments has saved"
            )
        drawn, count = np.random.Generator, self.num_envs
        sensors = self._sensors.save() | {"generators": dict}
        form = {
            "made_with": tuple,
            "backend": dict,
            "statistics": EpisodeStatistics,
            "sensors": sensors,
            "streams": tuple,
            "started": bool,
            "goal": self._host_goal(),
        }
        check_fits("snapshot", snapshot, form | others)
        steps = host(self.statistics.steps)
        check_fits("statistics.steps", snapshot["statistics"].steps, steps)
        arms = snapshot["sensors"]["generators"].keys() & range(count)
        check_fits("generators", snapshot["sensors"]["generators"], dict.fromkeys(arms, drawn))
        of_arm = Streams(*[drawn] * len(Streams._fields))  # type: ignore[arg-type]
        check_fits(
            "streams", snapshot["streams"], (of_arm,) * (count if snapshot["streams"] else 0)
        )

    def _made_with(self) -> tuple[str, str, int]:
        return self.robot.name, self.backend_name, self.num_envs

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Restore a snapshot that `check_snapshot` has checked.

        Raises:
            GymMaraError: the backend's part does not fit. Nothing has changed then.
        """
        self.backend.restore(snapshot["backend"])
        self.statistics = snapshot["statistics"].copy(self._tensor)
        self._sensors.restore(snapshot["sensors"])
        self.streams = copy.deepcopy(snapshot["streams"])
        self._started = snapshot["started"]
        self.outcome = None
        self.goal = Goal(*(self.backend.asarray(values.copy()) for values in snapshot["goal"]))

    def close(self) -> None:
        """Free the backend. A second call has no effect."""
        if not self._closed:
            self._closed = True
            self.backend.close()


def _sensor_noise(state: SimState) -> Floats | None:
    """The standard deviation of each arm's measured joint positions (N,), rad; None without sensor noise."""
    return None if state.parameters is None else state.parameters.get("sensor_noise")


def _report(state: SimState) -> dict[str, NDArray[Any]]:
    """The torques, contacts and random parameters of a state, for `info`, each (N, …)."""
    report: dict[str, NDArray[Any]] = {}
    if state.torque is not None:
        report["joint_torque"] = state.torque
    if state.contacts is not None:
        contacts = np.empty(len(state.contacts), dtype=object)
        for arm, found in enumerate(state.contacts):
            contacts[arm] = [contact._asdict() for contact in found]
        report["contacts"] = contacts
    if state.parameters is not None:
        report |= state.parameters
    return report
