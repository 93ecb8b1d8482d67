"""Plays an exported policy on an arm behind topics: observes, acts, and follows the targets that it is given."""

from __future__ import annotations

import gc
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from gym_mara.backends.ros2 import Ros2Backend
from gym_mara.deploy import OnnxPolicy
from gym_mara.envs import make_vector_env, task_keywords
from gym_mara.envs.given import Given
from gym_mara.envs.streams import Streams
from gym_mara.envs.workspace import RobotWorkspace
from gym_mara.errors import GymMaraError
from gym_mara.ros2.diagnostics import Diagnostics
from gym_mara.ros2.driver import ArmStoppedError, spare_what_is_loaded
from gym_mara.ros2.safety import Mode
from gym_mara.types import Floats

if TYPE_CHECKING:
    from gym_mara.ros2.link import RosLink
    from gym_mara.ros2.node import RosNode

_WINDOW = 1000
"""Over how many of the last actions their lateness is measured."""
_WAIT = 0.05
"""How often a deployment that waits looks for a target or a resume, s."""
_SLOW_WITHIN = 0.1
"""The error from which the steps of a policy shrink, m, where its task has such a setting and none is given. That is twice what a
training has: a real arm answers late, and would swing around some targets."""


class Target(NamedTuple):
    """A pose of the tool in the world."""

    position: tuple[float, ...]
    """(3,), m."""
    quaternion: tuple[float, ...] | None = None
    """(4,), [w, x, y, z]; None for a position alone."""


class Deployment:
    """A policy and the arm that it moves. The arm begins where it is, and rests until there is a target. It moves at once if the task
    has a target of its own.

    Args:
        policy: the policy.
        env: the name of an environment; None for that of the training.
        options: keyword arguments of the environment with the backend "ros2", which replace those of the training. Without
            `slow_within` the steps of a policy shrink from 0.1 m on, where the training had less. `on_collision` is none of them: the
            arm waits for an operator then, whatever the training had.
        log: is called with a line whenever what the arm does changes, and for each refused target; in a dry run also once a second
            with what would be sent.

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
        name = env or policy.about.env
        if "slow_within" in task_keywords(name):
            trained = policy.about.training.env_options.get("slow_within", 0.0)
            options = {"slow_within": max(trained, _SLOW_WITHIN), **options}
        if "on_collision" in options:
            raise GymMaraError(
                "on_collision cannot be set where a policy is deployed: after a collision ahead the arm waits for an operator, who "
                "resumes it; leave it out"
            )
        # "reset" would resume a stopped arm by itself.
        keywords = {**policy.keywords(env, "ros2", **options), "on_collision": "continue"}
        self._checks = ThreadPoolExecutor(1, "gym_mara targets")
        self._arms = make_vector_env(name, 1, **keywords)
        self.simulation = simulation = self._arms.simulation
        assert isinstance(simulation.backend, Ros2Backend)
        self.backend: Ros2Backend = simulation.backend
        self._driver, self._clock = self.backend.driver, self.backend.clock
        of_policy = self.backend.profile.of_policy
        self.target_topic = of_policy("target")
        """The topic of targets."""
        self.stop_service = of_policy("stop")
        """The service that stops the arm."""
        self.resume_service = of_policy("resume")
        """The service with which an operator lets a stopped arm move again."""
        simulation.streams = (Streams.of(np.random.default_rng(0)),)
        self.follows = simulation.task.random_goal
        """Whether the task reaches for the targets of `aim`; otherwise it has one of its own."""
        self.oriented = bool(getattr(simulation.task, "orientation", False))
        """Whether targets have an orientation."""
        self._workspace = RobotWorkspace(simulation.robot)  # used by one check at a time
        self._checking = threading.Lock()
        self._asked: Target | None = None
        self._next: Target | None = None
        self._target: Target | None = None
        self._lock = threading.Lock()
        self._ended = False
        self._steps, self._missed = 0, 0
        self._lateness: deque[float] = deque(maxlen=_WINDOW)
        self._error: float | None = None
        self._reached = False
        self._told = ""
        try:
            policy.check(self._arms)
            # What takes long the first time does so before the arm moves.
            self._act(self._begin())
            if self.follows:
                goal = simulation.goal
                quaternion = tuple(goal.quaternion[0]) if self.oriented else None
                self.check(Target(tuple(goal.position[0]), quaternion))
            spare_what_is_loaded()  # with all that has been loaded since the driver's start
        except BaseException:
            self.close()
            raise

    def _act(self, observation: Floats) -> Floats:
        """The action (1, A) of the policy for an observation (1, O)."""
        action, _ = self.policy.predict(self.simulation.present(observation))
        return action

    @property
    def _link(self) -> RosLink:
        from gym_mara.ros2.link import RosLink  # it imports ROS

        link = self._driver.link
        assert isinstance(link, RosLink)
        return link

    @property
    def node(self) -> RosNode:
        """The node of the connection to the arm."""
        return self._link.node

    @property
    def link_notes(self) -> tuple[str, ...]:
        """In what the connection to the arm differs from its profile."""
        return self._link.notes

    def aim(self, target: Target) -> Future[None]:
        """Reach for a target once it is checked, in a thread of its own: that takes long if it is out of reach. A target that is
        refused changes nothing. It may be called from any thread.

        Raises:
            GymMaraError: the task has a target of its own, or the deployment is closed.
        """
        if not self.follows:
            raise GymMaraError(
                f"{self.policy.about.env} has a target of its own, so that it follows no other"
            )
        with self._lock:
            self._asked = target
        try:
            return self._checks.submit(self._consider)
        except RuntimeError:
            raise GymMaraError("the deployment has ended, so that it takes no target") from None

    def _consider(self) -> None:
        """Check the newest target that is not checked yet."""
        with self._lock:
            asked, self._asked = self._asked, None
        if asked is None:
            return
        try:
            self.check(asked)
        except GymMaraError as error:
            self._log(f"target refused: {error}")
        else:
            with self._lock:
                self._next = asked
            if self._stopped:
                self._log(
                    f"the target is kept: the arm moves to it once {self.resume_service} is called"
                )

    def check(self, target: Target) -> None:
        """Check a target.

        Raises:
            GymMaraError: it is out of reach, or reached only with a collision, or not of the form that the task takes.
        """
        simulation = self.simulation
        one = np.ones(1, np.bool_)
        with self._checking:
            Given.of(_as_options(target), simulation.task, simulation.robot, self._workspace, one)

    def stop(self, reason: str) -> None:
        """Begin to decelerate to a hold until `resume`; return at once. It may be called from any thread.

        Raises:
            GymMaraError: the driver has failed, and stops nothing.
        """
        if self._driver.failure is not None:
            self._driver.check()
        self._driver.stop(reason)

    def resume(self) -> None:
        """Move again, from where the arm is. It may be called from any thread.

        Raises:
            GymMaraError: the arm cannot move from there.
        """
        self._driver.resume()

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
        self.backend.interrupted = lambda: self._over(end)
        while not self._over(end):
            try:
                self._driver.check()
                if not self.follows or self._take_target(began=False):
                    self._episode(end)
                else:
                    self._wait()
            except ArmStoppedError:
                self._wait_for_resume(end)

    def _over(self, end: float) -> bool:
        self._tell()
        return self._ended or self._clock.now() >= end

    def _tell(self) -> None:
        """Log what the arm does, when that changes."""
        status, _ = self._status
        if status != self._told:
            self._told = status
            go_on = f"; call {self.resume_service} to go on" if self._stopped else ""
            self._log(f"{status}{go_on}")

    def _wait(self) -> None:
        self._clock.sleep_until(self._clock.now() + _WAIT)

    def _take_target(self, began: bool) -> bool:
        """Whether there is a target; an episode that has begun goes on with a new one."""
        with self._lock:
            new, self._next = self._next, None
        if new is not None:
            self._target, self._reached = new, False
            if began:
                self.simulation.set_goal(new.position, new.quaternion or (1.0, 0.0, 0.0, 0.0))
        return self._target is not None

    def _episode(self, end: float) -> None:
        """Play from where the arm is until the end.

        Raises:
            ArmStoppedError: the arm is stopped.
        """
        simulation, period = self.simulation, self.backend.control_period
        observation = self._begin()
        while not self._over(end):
            if self.follows:
                self._take_target(began=True)
            outcome = simulation.step(self._act(observation))
            observation = outcome.observation
            self._note(outcome.info)
            if not self._driver.live and self._steps % max(1, round(1.0 / period)) == 0:
                self._log(f"would send: {', '.join(f'{q:.3f}' for q in self._setpoint)}")
            self._driver.check()

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
        self._lateness.append(float(info["lateness"][0]))
        self._error = float(info["distance"][0]) if "distance" in info else None
        self._reached = self._reached or bool(info.get("success", [False])[0])

    def _wait_for_resume(self, end: float) -> None:
        while not self._over(end):
            try:
                return self._driver.check()
            except ArmStoppedError:
                self._wait()
        return None

    @property
    def _setpoint(self) -> tuple[float, ...]:
        setpoint = self._driver.setpoint
        return () if setpoint is None else tuple(setpoint.q.tolist())

    @property
    def _stopped(self) -> bool:
        """Whether the safety filter holds the arm, or brings it to rest, until it is resumed."""
        held = self._driver.safety.mode in (Mode.STOPPING, Mode.STOPPED)
        return held and self._driver.failure is None

    @property
    def _status(self) -> tuple[str, bool]:
        """What the arm does, and whether that is trouble."""
        safety, failure = self._driver.safety, self._driver.failure
        if failure is not None:
            return f"failed: {failure}", True
        if self._stopped:
            return f"stopped: {safety.reason}", True
        state = self._driver.link.state
        age = np.inf if state is None else self._clock.now() - state.received
        if age > safety.watchdogs.state_age + _WAIT:
            return "hears nothing from the arm", True
        if self._target is not None:
            where = ", ".join(f"{value:.3f}" for value in self._target.position)
            return f"{'has reached' if self._reached else 'moves to'} {where} m", False
        return "waits for a target" if self.follows else "moves", False

    @property
    def diagnostics(self) -> Diagnostics:
        """What the deployment reports now."""
        late = np.array(self._lateness or [0.0])
        state = self._driver.link.state
        return Diagnostics(
            *self._status,
            self._steps,
            self._missed,
            (float(np.median(late)), float(np.quantile(late, 0.99))),
            np.inf if state is None else self._clock.now() - state.received,
            dict(self._driver.link.refused),
            self._driver.timing,
            self._error,
            self._setpoint,
        )

    def close(self) -> None:
        """Stop the arm, and end the connection."""
        try:
            self._arms.close()
        finally:
            self._checks.shutdown(wait=False, cancel_futures=True)
            gc.unfreeze()


def _as_options(target: Target) -> dict[str, Any]:
    options: dict[str, Any] = {"target_position": list(target.position)}
    if target.quaternion is not None:
        options["target_quaternion"] = list(target.quaternion)
    return options
