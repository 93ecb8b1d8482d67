"""Simulation: N arms of one robot, moved by one backend, judged by one task."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.spaces import Box, Space
from numpy.typing import ArrayLike, NDArray

from gym_mara.arrays import host, namespace, zeros_like
from gym_mara.backends import backend_settings, make_backend
from gym_mara.backends.registry import backend_defaults
from gym_mara.envs.actions import Actions, make_actions
from gym_mara.envs.episodes import Episodes
from gym_mara.envs.given import Given
from gym_mara.envs.options import Options
from gym_mara.envs.outcome import Outcome, report
from gym_mara.envs.sensors import Sensors, check_noise, noise_of
from gym_mara.envs.statistics import EpisodeStatistics
from gym_mara.envs.streams import Streams, check_streams, parameter_seeds
from gym_mara.errors import GymMaraError, whole_number
from gym_mara.rendering.settings import STATE
from gym_mara.robot.fingerprint import fingerprint
from gym_mara.snapshots import check_fits, check_same_arguments, plain
from gym_mara.state import SimState
from gym_mara.tasks import Goal, Observation
from gym_mara.tasks.observation import PACE, last_action
from gym_mara.types import Floats, Mask

if TYPE_CHECKING:
    from gym_mara.envs.pictured import Pictured

_ONLY_SPEED = {"workers", "threads", "collision_threads", "arrays", "device"}
"""Settings of backends that change how fast the numbers are computed, and at most their rounding."""


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
        try:
            self._prepare(options)
        except BaseException:
            self.backend.close()  # it may move an arm
            raise

    def _prepare(self, options: Options) -> None:
        """Make what the task and the actions need, for the backend's arms."""
        asarray = self.backend.asarray
        self.episodes = Episodes(self.task, self.robot, self.num_envs, asarray)
        """The start and the goal of each arm."""
        # A tensor of the backend's type and device; None with NumPy's arrays.
        self._tensor = None if self.backend.arrays == "numpy" else self.episodes.start
        self._started = False
        self._closed = False
        self._arguments: dict[str, Any] | None = None
        self.outcome: Outcome | None = None
        """The outcome of the last step."""
        # The arms that began an episode after the last step.
        self._began = asarray(np.zeros(self.num_envs, np.bool_))
        self.statistics = EpisodeStatistics(self.num_envs, self._tensor)
        self.streams: Sequence[Streams] = ()
        """The random generators of each arm; needed if `random` is true."""
        noise = noise_of(self.backend.state)
        check_noise(options.sensors, noise, tensors=self._tensor is not None)
        self._sensors = self._new_sensors()
        self.actions = self._new_actions()
        """What actions mean, and the last ones."""
        self.action_space: Box[np.float32] = self.actions.space
        """The space of one arm's actions."""
        parts = self.task.observation(
            self.robot, self.episodes.first_goal, self.backend.joint_velocity
        )
        if self.task.observes_action:
            parts = [*parts, last_action(self.action_space)]
        self.observation = Observation(parts, self.backend.overshoot)
        self._pace = self.observation.place(PACE)
        overshoot = self.backend.overshoot
        self._observed_range = (
            asarray(self.robot.lower - overshoot),
            asarray(self.robot.upper + overshoot),
        )
        self.form_space: Space[Any] = self.observation.space
        """The space of one arm's observation in the form of `form`, without pictures."""
        self.pixels: Pictured | None = None
        """Adds pictures to observations; None without pictures."""
        if options.pixels.observation != STATE:
            from gym_mara.envs.pictured import Pictured  # it imports graphics libraries

            self.pixels = Pictured(self)
        # The range of joint targets (J,), rad (m).
        self.target_low, self.target_high = self.actions.target_low, self.actions.target_high

    @property
    def observation_space(self) -> Space[Any]:
        """The space of one arm's observation in the form of `present`."""
        return self.form_space if self.pixels is None else self.pixels.space(self.form_space)

    @property
    def goal(self) -> Goal:
        """The goal of each arm."""
        return self.episodes.goal

    @property
    def random(self) -> bool:
        """Whether episodes have random parameters or goals, so that `reset` needs `streams`."""
        pictures = self.pixels is not None and self.pixels.random
        return self.backend.random or self.task.random_goal or pictures

    def reset(
        self, mask: Mask | None = None, given: Given | None = None
    ) -> tuple[Floats, dict[str, NDArray[Any]]]:
        """Begin new episodes of all arms, or of the arms that the mask (N,) selects.

        Args:
            mask: in the backend's arrays.
            given: what the task does not draw, from `Episodes.given`.

        Returns:
            The observations (N, O); and torques, contacts and random parameters, each (N, …), if the state has them.
        """
        self._check_open()
        self.episodes.begin(self.streams, mask, given)
        start = self.episodes.start
        if self.backend.random:
            arms = np.ones(self.num_envs, np.bool_) if mask is None else host(mask)
            self.backend.begin_episodes(parameter_seeds(self.streams, arms), arms)
        self.backend.reset(start, mask)
        chosen = slice(None) if mask is None else mask
        self.statistics.clear(chosen)
        first, self._started = not self._started, True
        self._began[chosen] = True
        if self.pixels is not None:
            self.pixels.begin(self, mask)
        state, q = self.backend.state, start
        if first and self.task.start_q is not None:
            self.episodes.warn_of_collisions(state.collided)
        noise = noise_of(state)
        if noise is not None:
            arms = np.ones(self.num_envs, np.bool_) if mask is None else mask
            self._sensors.begin_episodes(self.streams, arms)
            q = self._measured_start(noise, arms)
        self.actions.begin(q, mask)
        state.fill_actions(self.actions.action, self.actions.last_action)
        observation = self._observe(state, noise)
        self._set_pace(observation, mask)
        return observation, report(state)

    def _measured_start(self, noise: Floats, arms: Mask) -> Floats:
        """Where the sensors see the chosen arms (N,) at the start pose: joint positions (N, J), rad."""
        self._sensors.begin(self.episodes.start, noise, arms)
        return self._sensors.q

    def step(self, action: ArrayLike) -> Outcome:
        """Execute the actions (N, A) of all arms for one control period.

        Raises:
            GymMaraError: the action has the wrong type or shape, or is not finite. No arm moves then.
            ResetNeeded: the environment was not reset.
            ClosedEnvironmentError: the environment is closed.
        """
        self._check_ready()
        return self._move_to(self.actions.targets(action))

    def step_towards(self, q_target: ArrayLike) -> Outcome:
        """Move every arm towards joint targets (N, J), rad (m), for one control period, whatever actions mean.

        Raises:
            GymMaraError, ResetNeeded, ClosedEnvironmentError: as in `step`.
        """
        self._check_ready()
        return self._move_to(self.actions.override(q_target))

    def _check_ready(self) -> None:
        if self._closed or not self._started:
            self._check_open()
            raise ResetNeeded("call reset() before the first step()")

    def _move_to(self, q_target: Floats) -> Outcome:
        """Move every arm towards joint targets (N, J) for one control period, and judge the result."""
        start = self.episodes.start
        xp = namespace(start)
        state, actions = self.backend.step(q_target), self.actions
        state.fill_actions(actions.action, actions.last_action)
        self._began[...] = False
        noise = noise_of(state)
        if noise is not None:
            self._sensors.measure(state.q, noise)
        if actions.stepping:
            actions.see(state.q if noise is None else self._sensors.q)
        observation = self._observe(state, noise)
        self._set_pace(observation)
        reward, terms = self._reward(state, observation)
        terminated = self.task.terminated(state, self.goal)
        collided = state.collided
        if self.task.on_collision == "terminate":
            terminated = terminated | collided
        elif self.task.on_collision == "reset" and (count := xp.count_nonzero(collided)):
            self.backend.reset(start, None if count == self.num_envs else collided)
            q = start if noise is None else self._measured_start(noise, collided)
            actions.begin(q, collided)
        distance = terms["distance"] if "distance" in terms else zeros_like(reward) + np.nan
        self.statistics.add(distance, reward, collided)
        diverged = state.diverged
        truncated = diverged if diverged is not None and xp.count_nonzero(diverged) else None
        info = {**terms, "collided": collided, **report(state)}
        self.outcome = Outcome(observation, reward, terminated, truncated, info, state)
        return self.outcome

    def rewards(self, state: SimState) -> tuple[Floats, dict[str, NDArray[Any]]]:
        """The rewards (N,) of a state without sensor noise, and their terms; a state without actions gets the last ones."""
        if state.action is None:
            state = copy.copy(state)
            state.fill_actions(self.actions.action, self.actions.last_action)
        return self._reward(state, self._observe(state, None))

    def judged(self, state: SimState) -> dict[str, NDArray[Any]]:
        """The info of a step to a state without sensor noise."""
        return {**self.rewards(state)[1], "collided": state.collided, **report(state)}

    def _reward(
        self, state: SimState, observation: Floats
    ) -> tuple[Floats, dict[str, NDArray[Any]]]:
        """The rewards (N,) of a state with its observations (N, O), and their terms."""
        return self.task.reward(state, self.goal)

    def form(self, flat: Floats) -> Any:
        """Flat observations (…, O) in the form of `form_space`."""
        return flat

    def present(self, flat: Floats, arms: NDArray[np.int64] | None = None) -> Any:
        """Flat observations (n, O) in the form of the observation space.

        Args:
            flat: of some arms. If there are pictures, they are of the last observations of these arms.
            arms: their indices (n,); None for all N arms.
        """
        if self.pixels is None:
            return self.form(flat)
        return self.pixels.present(self, flat, arms)

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
        self.episodes.set_goal(position, quaternion, self.backend.state.q)

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
        self._arguments = None
        self._sensors = self._new_sensors()
        noise = noise_of(backend.state)
        if noise is not None:
            self._sensors.begin_episodes(self.streams, everyone)
            self._sensors.begin(q, noise, everyone)
            q = self._sensors.q
        pace, self.actions = self.actions.pace, self._new_actions()
        self.actions.begin(q, None)
        self.actions.pace = pace

    def _new_actions(self) -> Actions:
        return make_actions(
            self.options.actions, self.task.default_action, self.robot, self.backend
        )

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

    def _set_pace(self, observation: Floats, mask: Mask | None = None) -> None:
        """Note the pace of the next actions from the observations (N, O) to which they respond.

        With a mask (N,) the other arms respond to an earlier observation, and keep its pace.
        """
        if self._pace is None:
            return
        xp, pace = namespace(observation), observation[:, self._pace]
        if mask is None:
            self.actions.pace = xp.asarray(pace, copy=True)
        else:
            self.actions.pace = xp.where(mask[:, None], pace, self.actions.pace)

    def _check_open(self) -> None:
        if self._closed:
            raise ClosedEnvironmentError("the environment is closed; make a new one")

    def save(self) -> dict[str, Any]:
        """A snapshot of the arms, the sensors, the last actions, the random generators, the goals and the statistics."""
        return {
            "made_with": dict(self._made_with()),
            "backend": self.backend.save(),
            "statistics": self.statistics.copy(),
            "sensors": self._sensors.save(),
            "actions": self.actions.save(),
            "streams": copy.deepcopy(self.streams),
            "started": self._started,
            "appearance": None if self.pixels is None else self.pixels.save(),
            **self.episodes.save(),
        }

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
        check_same_arguments(made_with, self._made_with())
        form = {
            "made_with": type(made_with),
            "backend": dict,
            "statistics": EpisodeStatistics,
            "sensors": dict,
            "actions": self.actions.save(),
            "streams": tuple,
            "started": bool,
            "appearance": type(None) if self.pixels is None else self.pixels.save(),
            **self.episodes.save(),
        }
        check_fits("snapshot", snapshot, form | others)
        steps = host(self.statistics.steps)
        check_fits("statistics.steps", snapshot["statistics"].steps, steps)
        self._sensors.check(snapshot["sensors"])
        check_streams(snapshot["streams"], self.num_envs)

    def _made_with(self) -> dict[str, Any]:
        """The arguments on which the numbers depend, and their defaults, as plain values; not those of pictures."""
        if self._arguments is None:
            defaults = backend_defaults(self.backend_name)
            given = self.options.settings
            settings = {name: given.get(name, value) for name, value in defaults.items()}
            parts = self.options.actions, self.options.sensors, self.task
            self._arguments = plain(
                {
                    **{f.name: getattr(p, f.name) for p in parts for f in dataclasses.fields(p)},
                    **{name: settings[name] for name in settings.keys() - _ONLY_SPEED},
                    "task": type(self.task).__qualname__,
                    "robot": self.robot.name,
                    "robot_fingerprint": fingerprint(self.robot),
                    "backend": self.backend_name,
                    "num_envs": self.num_envs,
                    "action": self.actions.mode,
                    **self._goal_settings(),
                }
            )
        return self._arguments

    def _goal_settings(self) -> dict[str, Any]:
        """The keyword arguments of a goal environment, and whether it is one."""
        return {"goal_environment": False}

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Restore a snapshot that `check_snapshot` has checked.

        Raises:
            GymMaraError: the backend's part does not fit. Nothing has changed then.
        """
        self.backend.restore(snapshot["backend"])
        self.statistics = snapshot["statistics"].copy(self._tensor)
        self._sensors.restore(snapshot["sensors"])
        self.actions.restore(snapshot["actions"])
        self.streams = copy.deepcopy(snapshot["streams"])
        self._started = snapshot["started"]
        if self.pixels is not None:
            self.pixels.restore(snapshot["appearance"])
        self.outcome = None
        self.episodes.restore(snapshot)

    def close(self) -> None:
        """Free the backend. A second call has no effect."""
        if not self._closed:
            self._closed = True
            self.backend.close()
