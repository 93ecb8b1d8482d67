"""The backend "ros2": an arm behind ROS 2's topics, real or simulated, in wall-clock time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar, NoReturn

import numpy as np

from gym_mara.backends.base import Backend
from gym_mara.collision import make_checker
from gym_mara.collision.free_poses import straight_move
from gym_mara.errors import GymMaraError, flag, positive_number
from gym_mara.robot import RobotModel
from gym_mara.ros2.arm import ArmState, Clock, Link, WallClock
from gym_mara.ros2.driver import ArmStoppedError, Driver
from gym_mara.ros2.profiles import make_profile
from gym_mara.ros2.safety.filter import SafetyFilter, Watchdogs
from gym_mara.ros2.safety.motion import MotionLimits
from gym_mara.state import SimState
from gym_mara.types import Floats, Mask

_RESET_SPEED = 0.25
"""The share of the velocity limits with which `reset` moves the arm to a start pose."""
_ARRIVED = 0.01
"""How near each joint comes to a start pose, rad (m)."""
_STILL = 0.05
"""The largest velocity of a joint that has arrived there, rad/s (m/s), unless `rest_velocity` is larger."""
_CONNECTING = 5.0
"""How long the first state of the arm may take, s."""
_RESET_TIME = 1.5
"""How much longer than by the limits a motion to a start pose takes at most."""
_ARRIVAL_TIME = 5.0
"""How much longer still, s: an arm follows its set-points late, and comes to rest."""
_INTERRUPTED = "the motion to the start pose was interrupted"


class Ros2Backend(Backend):
    """One arm behind topics. Every command passes the safety filter, which replaces no emergency stop.

    A step commands joint targets and waits for the end of its control period. `reset` moves the arm slowly to the start pose, on
    a straight joint move that is checked for collisions. A collision that is predicted ahead stops the arm, and the state says
    that it has collided; the next `reset` resumes it. Any other stop raises `gym_mara.ros2.driver.ArmStoppedError` until an
    operator resumes the arm. Nothing is sent without `live`.

    Args:
        robot: the arm.
        num_envs: 1.
        control_period: s.
        profile: the form of commands and states: the name of a profile (`gym_mara.ros2.profiles`).
        controller: the name of the controller, which is part of its topics; by default that of the profile.
        namespace: of the arm's topics, such as "/left".
        domain: the ROS domain; by default that of the environment variable ROS_DOMAIN_ID, or 0.
        live: whether the arm moves. Without it nothing is sent, and the arm stays where it is.
        max_joint_velocity: rad/s (m/s), where it is below the robot's limits. With the profile "mara-2019" it is the velocity in the
            points, too, with which each servo moves there; by default 0.5 there.
        max_joint_acceleration: rad/s² (m/s²); by default the velocity is reached in 0.2 s.
        max_joint_jerk: rad/s³ (m/s³); by default the acceleration is reached in 0.1 s.
        setpoint_period: the time between two set-points, s.
        command_age: the arm stops if no action has come for so long, s. A training that pauses to learn needs more.
        tracking_error: the arm stops if a joint is so far from its set-point, rad (m).
        rest_velocity: the arm starts and resumes only while no joint is measured to be faster, rad/s (m/s). Noisy encoders need more.
        collision: the collision engine, as of the backend "pinocchio".

    Raises:
        GymMaraError: a setting is out of its range, or there is no arm, or it cannot be moved.
        MissingExtraError: ROS 2 or a library of the extra ros2 is missing.
    """

    most_arms: ClassVar[int] = 1
    overshoot = 0.05
    _in_thread: ClassVar[bool] = True
    """Whether a thread sends set-points; false for tests with a clock of their own."""

    def __init__(
        self,
        robot: RobotModel,
        num_envs: int,
        *,
        control_period: float = 0.02,
        profile: str = "trajectory",
        controller: str | None = None,
        namespace: str = "",
        domain: int | None = None,
        live: bool = False,
        max_joint_velocity: float | None = None,
        max_joint_acceleration: float | None = None,
        max_joint_jerk: float | None = None,
        setpoint_period: float = 0.01,
        command_age: float = 0.2,
        tracking_error: float = 0.2,
        rest_velocity: float = 0.02,
        collision: str = "coal",
    ) -> None:
        super().__init__(robot, num_envs, control_period=control_period)
        self.profile = make_profile(profile, controller=controller, namespace=namespace)
        """How to speak to the arm."""
        own = self.profile.velocity
        fastest = own if max_joint_velocity is None else max_joint_velocity
        limits = MotionLimits.of(robot, fastest, max_joint_acceleration, max_joint_jerk)
        self._limits, self.joint_velocity = limits, limits.velocity
        self._checker = make_checker(collision, robot)
        self._kinematics = robot.kinematics()
        period = positive_number("setpoint_period", setpoint_period, "s", at_most=control_period)
        watchdogs = Watchdogs(
            command_age=command_age, tracking_error=tracking_error, rest_velocity=rest_velocity
        )
        safety = SafetyFilter(robot, period, limits, watchdogs, make_checker(collision, robot))
        live = flag("live", live)
        link, clock = self._connect(
            profile,
            controller=controller,
            namespace=namespace,
            # The servos are as fast as the points say, and shall follow.
            velocity=None if own is None else float(limits.velocity.max()),
            domain=domain,
            commands=live,
        )
        self.clock: Clock = clock
        """Sets the pace."""
        self.driver = Driver(link, safety, self.clock, live=live)
        """Moves the arm."""
        self.interrupted: Callable[[], bool] = lambda: False
        """Whether a motion to a start pose shall end before it arrives; then the arm stops, and `reset` raises ArmStoppedError."""
        self._began = self._due = self.clock.now()
        self._lateness = self._missed = 0.0
        try:
            self.driver.start(thread=self._in_thread)
        except BaseException:
            self.driver.close()
            raise

    def _connect(self, profile: str, **options: Any) -> tuple[Link, Clock]:
        """The connection to the arm, which has reported its state, and the clock."""
        from gym_mara.ros2.link import RosLink

        link = RosLink(self.robot, profile, **options)
        try:
            link.wait(_CONNECTING)
        except BaseException:
            link.close()
            raise
        return link, WallClock()

    def reset(self, q: Floats, mask: Mask | None = None) -> None:
        if mask is not None and not mask[0]:
            return
        self.driver.resume_if_blocked()
        self.driver.check()
        if self.driver.live:
            self._move_to(q[0])
        self._began = self._due = self.clock.now()
        self._lateness = self._missed = 0.0

    def _move_to(self, goal: Floats) -> None:
        """Move the arm slowly to a configuration (J,), rad (m), and wait until it rests there.

        Raises:
            GymMaraError: something is in the way, or the arm does not arrive.
        """
        here = self._reported().q
        if not self._rests_at(goal):
            if self._checker.check(np.vstack([straight_move(here, goal), goal])).any():
                raise GymMaraError(
                    f"the straight joint move from {here.round(3).tolist()} to the start pose {goal.round(3).tolist()} collides: "
                    "move the arm to a place with a free way, or give a start_q that has one"
                )
            self.driver.safety.speed = _RESET_SPEED
            try:
                self._wait_at(goal)
            except ArmStoppedError:
                raise
            except BaseException:
                self.driver.stop(_INTERRUPTED)
                raise
            finally:
                self.driver.safety.speed = 1.0

    def _wait_at(self, goal: Floats) -> None:
        # An arm that still moves brakes before, and returns.
        least = self._limits.duration(goal - self._reported().q, _RESET_SPEED)
        allowed = _RESET_TIME * (least + 3.0 * self.driver.safety.longest_stop) + _ARRIVAL_TIME
        end = self.clock.now() + allowed
        while not self._rests_at(goal):
            if self.interrupted():
                self.driver.stop(_INTERRUPTED)
            elif self.clock.now() > end:
                off = np.abs(self._reported().q - goal)
                joint = int(off.argmax())
                raise GymMaraError(
                    f"the arm has not reached the start pose within {allowed:.3g} s: joint {self.robot.joint_names[joint]} is "
                    f"{off[joint]:.3g} rad (m) away; is its controller active, and does it follow?"
                )
            self.driver.command(goal)
            self.clock.sleep_until(self.clock.now() + self.control_period)

    def _rests_at(self, goal: Floats) -> bool:
        state = self._reported()
        slow = max(_STILL, self.driver.safety.watchdogs.rest_velocity)
        near, still = np.abs(state.q - goal) < _ARRIVED, np.abs(state.qd) < slow
        return bool(near.all() and still.all())

    def step(self, q_target: Floats) -> SimState:
        late = self.clock.now() - self._due
        self._lateness, self._missed = max(0.0, late), float(max(0.0, late // self.control_period))
        self._due += (self._missed + 1.0) * self.control_period
        try:
            self.driver.command(q_target[0])
            self.clock.sleep_until(self._due)
            self.driver.check()
        except ArmStoppedError:
            if not self.driver.safety.blocked:
                raise
            self.clock.sleep_until(self._due)
        return self.state

    def _reported(self) -> ArmState:
        state = self.driver.link.state
        assert state is not None  # `_connect` has waited for it
        return state

    @property
    def state(self) -> SimState:
        reported = self._reported()
        q = reported.q[None].copy()
        qd = np.clip(reported.qd, -self.joint_velocity, self.joint_velocity)[None]
        position, quaternion = self._kinematics.pose(q)
        now = self.clock.now()
        timing = {
            "lateness": self._lateness,
            "missed_ticks": self._missed,
            "state_age": now - reported.received,
        }
        return SimState(
            q=q,
            qd=qd,
            ee_position=position,
            ee_quaternion=quaternion,
            ee_velocity=self._kinematics.velocity(q, qd),
            collided=self._checker.check(q) | self.driver.safety.blocked,
            time=np.array([now - self._began]),
            torque=None if reported.effort is None else reported.effort[None].copy(),
            timing={name: np.array([value]) for name, value in timing.items()},
        )

    def save(self) -> NoReturn:
        raise GymMaraError(
            "the state of a real arm cannot be saved: leave out snapshots with backend='ros2'"
        )

    def restore(self, snapshot: dict[str, Any]) -> NoReturn:
        raise GymMaraError(
            "a real arm cannot be put into the state of a snapshot; reset() moves it to a start pose"
        )

    def __getstate__(self) -> NoReturn:
        raise GymMaraError("an environment with a real arm can be neither copied nor pickled")

    def close(self) -> None:
        self.driver.close()
