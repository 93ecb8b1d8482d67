"""Plays an exported policy on an arm behind topics: observes, acts, and follows the targets that it is given."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gym_mara.backends.ros2 import Ros2Backend
from gym_mara.deploy import OnnxPolicy
from gym_mara.envs import make_vector_env
from gym_mara.envs.given import Given
from gym_mara.envs.streams import Streams
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError
from gym_mara.ros2.driver import ArmStoppedError, Timing
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.ros2.node import RosNode

_WAIT = 0.05
"""How often a deployment that waits looks for a target or a resume, s."""


class Target(NamedTuple):
    """A pose of the tool in the world."""

    position: tuple[float, ...]
    """(3,), m."""
    quaternion: tuple[float, ...] | None = None
    """(4,), [w, x, y, z]; None for a position alone."""


class Diagnostics(NamedTuple):
    """What a deployment reports about itself."""

    status: str
    """What the arm does: "waits for a target", "moves", or why it has stopped."""
    steps: int
    missed_ticks: int
    """Of the policy, control periods."""
    lateness: tuple[float, float]
    """How long after its tick an action came, s: the median and the 99th percentile of the last actions."""
    state_age: float
    """Of the last state, s."""
    refused: dict[str, int]
    """How many messages of the arm were refused, by reason."""
    setpoints: Timing
    """Of the thread that sends set-points."""
    error: float | None
    """The distance to the target, m; None where there is none yet."""

    def rows(self) -> list[tuple[str, str]]:
        """The figures with their names, as text."""
        late, ticks = self.lateness, self.setpoints
        refused = ", ".join(f"{reason} {count}" for reason, count in self.refused.items())
        return [
            (
                "distance to the target, mm",
                "-" if self.error is None else f"{1e3 * self.error:.3f}",
            ),
            ("actions", f"{self.steps:,}"),
            ("missed control periods", f"{self.missed_ticks:,}"),
            ("lateness of actions, p50 and p99, ms", f"{1e3 * late[0]:.2f}, {1e3 * late[1]:.2f}"),
            ("set-points", f"{ticks.ticks:,}"),
            ("missed set-points", f"{ticks.missed:,}"),
            (
                "jitter of set-points, p50, p99 and largest, ms",
                ", ".join(f"{1e3 * value:.2f}" for value in ticks.lateness),
            ),
            ("age of the arm's state, ms", f"{1e3 * self.state_age:.1f}"),
            ("refused messages", refused or "none"),
        ]


class Deployment:
    """A policy and the arm that it moves. The arm begins where it is, and rests until there is a target.

    Args:
        policy: the policy.
        env: the name of an environment; None for that of the training.
        options: keyword arguments of the environment with the backend "ros2", which replace those of the training.
        log: is called with a sentence about a refused target and about each stop.

    Raises:
        GymMaraError: the policy does not fit the environment, an option is unknown, there is no arm, or it cannot be moved.
        MissingExtraError: ROS 2 or a library is missing.
    """

    def __init__(
        self,
        policy: OnnxPolicy,
        env: str | None,
        options: dict[str, Any],
        log: Callable[[str], None],
    ) -> None:
        self.policy, self._log = policy, log
        keywords = policy.keywords(env, "ros2", **options)
        keywords.setdefault("on_collision", "continue")
        self._arms = make_vector_env(env or policy.about.env, 1, **keywords)
        self.simulation = simulation = self._arms.simulation
        assert isinstance(simulation.backend, Ros2Backend)
        self.backend: Ros2Backend = simulation.backend
        self._clock = self.backend.clock
        simulation.streams = (Streams.of(np.random.default_rng(0)),)
        self.follows = simulation.task.random_goal
        """Whether the task reaches for the targets of `aim`; otherwise it has one of its own."""
        self.oriented = bool(getattr(simulation.task, "orientation", False))
        """Whether targets have an orientation."""
        self._workspace = RobotWorkspace(simulation.robot)  # of the thread that checks targets
        self._checks = ThreadPoolExecutor(1, "gym_mara targets")
        self._asked: Target | None = None
        self._next: Target | None = None
        self._target: Target | None = None
        self._lock = threading.Lock()
        self._ended = False
        self._steps, self._missed = 0, 0
        self._lateness: list[float] = []
        self._status = "waits for a target"
        self._error: float | None = None
        try:
            policy.check(self._arms)
            # What takes long the first time does so before the arm moves.
            self._act(self._begin())
            if self.follows:
                goal = simulation.goal
                quaternion = tuple(goal.quaternion[0]) if self.oriented else None
                self.check(Target(tuple(goal.position[0]), quaternion))
        except BaseException:
            self.close()
            raise

    def _act(self, observation: Floats) -> Floats:
        """The action (1, A) of the policy for an observation (1, O)."""
        action, _ = self.policy.predict(self.simulation.present(observation))
        return action

    @property
    def node(self) -> RosNode:
        """The node of the connection to the arm."""
        from gym_mara.ros2.link import RosLink  # it imports ROS

        link = self.backend.driver.link
        assert isinstance(link, RosLink)
        return link.node

    def aim(self, target: Target) -> Future[None]:
        """Reach for a target once it is checked, in a thread of its own: that takes long if it is out of reach. A target that is
        refused changes nothing. It may be called from any thread.

        Raises:
            GymMaraError: the task has a target of its own.
        """
        if not self.follows:
            raise GymMaraError(
                f"{self.policy.about.env} has a target of its own, so that it follows no other"
            )
        with self._lock:
            self._asked = target
        return self._checks.submit(self._consider)

    def _consider(self) -> None:
        """Check the newest target that is not checked yet."""
        with self._lock:
            asked, self._asked = self._asked, None
        if asked is None:
            return
        try:
            self.check(asked)
        except GymMaraError as error:
            self._log(f"the target {[*asked.position]} is refused: {error}")
        else:
            with self._lock:
                self._next = asked

    def check(self, target: Target) -> None:
        """Check a target.

        Raises:
            GymMaraError: it is out of reach, or reached only with a collision, or not of the form that the task takes.
        """
        simulation = self.simulation
        one = np.ones(1, np.bool_)
        Given.of(_as_options(target), simulation.task, simulation.robot, self._workspace, one)

    def stop(self, reason: str) -> None:
        """Decelerate to a hold until `resume`. It may be called from any thread."""
        self.backend.driver.stop(reason)

    def resume(self) -> None:
        """Move again, from where the arm is. It may be called from any thread.

        Raises:
            GymMaraError: the arm cannot move from there.
        """
        self.backend.driver.resume()

    def end(self) -> None:
        """Let `run` return. It may be called from any thread and by a signal handler."""
        self._ended = True

    def run(self, seconds: float | None = None) -> None:
        """Play the policy.

        Args:
            seconds: how long; None until `end` is called.

        Raises:
            GymMaraError: the arm cannot be driven any more.
        """
        end = np.inf if seconds is None else self._clock.now() + seconds
        while not self._over(end):
            if not self.follows or self._take_target(began=False):
                self._episode(end)
            else:
                self._status = "waits for a target"
                self._wait()

    def _over(self, end: float) -> bool:
        return self._ended or self._clock.now() >= end

    def _wait(self) -> None:
        self._clock.sleep_until(self._clock.now() + _WAIT)

    def _take_target(self, began: bool) -> bool:
        """Whether there is a target; an episode that has begun goes on with a new one."""
        with self._lock:
            new, self._next = self._next, None
        if new is not None:
            self._target = new
            if began:
                self.simulation.set_goal(new.position, new.quaternion or (1.0, 0.0, 0.0, 0.0))
        return self._target is not None

    def _episode(self, end: float) -> None:
        """Play from where the arm is, until a stop or the end."""
        simulation = self.simulation
        try:
            observation = self._begin()
            self._status = "moves"
            while not self._over(end):
                if self.follows:
                    self._take_target(began=True)
                outcome = simulation.step(self._act(observation))
                observation = outcome.observation
                self._note(outcome.info)
                self.backend.driver.check()
        except ArmStoppedError as error:
            self._wait_for_resume(error, end)

    def _begin(self) -> Floats:
        """Begin an episode at the measured pose, and return the observation (1, O)."""
        simulation = self.simulation
        q = np.clip(self.backend.state.q, simulation.robot.lower, simulation.robot.upper)
        options: dict[str, Any] = {"start_q": q[0].tolist()}
        if self._target is not None:
            options |= _as_options(self._target)
        observation, _ = simulation.reset(given=simulation.episodes.given(options))
        return observation

    def _note(self, info: dict[str, Any]) -> None:
        self._steps += 1
        self._missed += int(info["missed_ticks"][0])
        self._lateness = [*self._lateness[-999:], float(info["lateness"][0])]
        self._error = float(info["distance"][0]) if "distance" in info else None

    def _wait_for_resume(self, error: ArmStoppedError, end: float) -> None:
        self._log(str(error))
        self._status = f"stopped: {self.backend.driver.safety.reason}"
        while not self._over(end):
            try:
                self.backend.driver.check()
                break
            except ArmStoppedError:
                self._wait()

    @property
    def diagnostics(self) -> Diagnostics:
        """What the deployment reports now."""
        link = self.backend.driver.link
        late = np.array(self._lateness or [0.0])
        state = link.state
        return Diagnostics(
            self._status,
            self._steps,
            self._missed,
            (float(np.median(late)), float(np.quantile(late, 0.99))),
            np.inf if state is None else self._clock.now() - state.received,
            dict(link.refused),
            self.backend.driver.timing,
            self._error,
        )

    def close(self) -> None:
        """Stop the arm, and end the connection."""
        self._checks.shutdown(cancel_futures=True)
        self._arms.close()


def _as_options(target: Target) -> dict[str, Any]:
    options: dict[str, Any] = {"target_position": list(target.position)}
    if target.quaternion is not None:
        options["target_quaternion"] = list(target.quaternion)
    return options
