"""Random, hostile sequences of commands, states, times, stops and resumes: what always holds of the set-points."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gym_mara.collision.coal import CoalChecker
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.ros2.arm import ArmState, Setpoint
from gym_mara.ros2.safety.filter import Mode, SafetyFilter
from gym_mara.ros2.safety.motion import MotionLimits
from tests.helpers import Floats, robot_model
from tests.ros2.safety.arms import LONGEST_STOP, state_of

EVENTS = (
    *("go", "near", "flip", "into") * 3,
    *("beyond", "nan", "shape", "stale", "missing", "no state", "old state", "lost"),
    *("clock stands", "clock back", "stop", "speed", "resume"),
)
"""What may happen. Most are targets, so that the arm moves."""


@functools.cache
def colliding(name: str) -> Floats:
    """Some configurations of a robot that collide (K, J)."""
    robot = robot_model(name)
    q = np.random.default_rng(0).uniform(robot.lower, robot.upper, (1000, robot.num_joints))
    return q[CoalChecker(robot).check(q)]


class World:
    """An arm that follows its filter, and everything that can go wrong; each tick checks what always holds."""

    def __init__(self, robot: RobotModel, period: float, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.robot, self.period = robot, period
        self.limits = MotionLimits.of(robot)
        self.filter = SafetyFilter(robot, period, self.limits, checker=CoalChecker(robot))
        self.now, self.stopping = 0.0, 0
        self.command: Any = robot.home
        self.obstacles = colliding(robot.name)
        self.last = Setpoint(robot.home, *np.zeros((2, robot.num_joints)))
        self.path = [robot.home]
        self.filter.start(state_of(robot.home, self.now), self.now)

    def event(self, name: str) -> None:
        """Let something happen, and the arm go on for some ticks."""
        rng, robot = self.rng, self.robot
        if self.filter.mode is Mode.STOPPED and rng.random() < 0.7:
            self.resume()
        if name == "go":
            self.command = rng.uniform(robot.lower, robot.upper)
        elif name == "into":
            self.command = self.obstacles[rng.integers(len(self.obstacles))]
        elif name == "near":
            self.command = self.last.q + rng.uniform(-0.2, 0.2, robot.num_joints)
        elif name == "flip":
            self.command = np.where(rng.random(robot.num_joints) < 0.5, robot.lower, robot.upper)
        elif name == "beyond":
            self.command = rng.normal(0.0, 10.0 ** rng.uniform(0, 300), robot.num_joints)
        elif name == "stop":
            self.filter.stop("the operator's wish")
        elif name == "speed":
            self.filter.speed = float(rng.uniform(0.01, 1.0))
        elif name == "resume":
            self.resume()
        self.tick(**self.trouble(name))
        for _ in range(int(rng.integers(0, 150 if name == "into" else 40))):
            self.tick()

    def trouble(self, name: str) -> dict[str, Any]:
        """What is wrong with the arguments of a tick."""
        now, q = self.now + self.period, self.last.q
        troubles: dict[str, dict[str, Any]] = {
            "nan": {"command": np.full(len(q), np.nan)},
            "shape": {"command": np.zeros(len(q) + 1)},
            "stale": {"commanded": now - 1.0},
            "missing": {"command": None},
            "no state": {"state": None},
            "old state": {"state": state_of(q, now - 1.0)},
            "lost": {"state": state_of(q + 0.5, now)},
            "clock stands": {"now": self.now},
            "clock back": {"now": self.now - 1.0},
        }
        return troubles.get(name, {})

    def resume(self) -> None:
        """Resume from a measured pose near the set-point, unless that is refused."""
        near = self.last.q + self.rng.normal(0.0, 0.005, self.robot.num_joints)
        q = np.clip(near, self.robot.lower, self.robot.upper)
        try:
            self.filter.resume(ArmState(q, 0.0 * q, None, self.now, 0.0), self.now)
        except GymMaraError:
            return
        self.last = Setpoint(q, 0.0 * q, 0.0 * q)
        assert self.filter.mode is Mode.WAITING

    def tick(self, **trouble: Any) -> None:
        """A tick, and what always holds after it."""
        self.now += self.period
        arguments = {
            "now": self.now,
            "state": state_of(self.last.q, self.now),
            "command": self.command,
            "commanded": self.now,
        }
        before, mode = self.last, self.filter.mode
        self.last = setpoint = self.filter.step(**{**arguments, **trouble})
        self.path.append(setpoint.q)
        self.is_within_limits(before, setpoint)
        stopped = self.filter.mode in (Mode.STOPPING, Mode.STOPPED)
        assert bool(self.filter.reason) == stopped
        self.stopping = self.stopping + 1 if self.filter.mode is Mode.STOPPING else 0
        assert self.stopping * self.period < LONGEST_STOP
        if mode is Mode.STOPPED:
            np.testing.assert_array_equal(setpoint.q, before.q)
        if self.filter.mode is Mode.STOPPED:
            assert not setpoint.qd.any()
            assert not setpoint.qdd.any()

    def is_within_limits(self, before: Setpoint, setpoint: Setpoint) -> None:
        """Check position, velocity, acceleration and jerk, and that they belong together."""
        robot, limits, dt = self.robot, self.limits, self.period
        assert (setpoint.q >= robot.lower).all()
        assert (setpoint.q <= robot.upper).all()
        assert (np.abs(setpoint.qd) <= limits.velocity * (1.0 + 1e-9)).all()
        assert (np.abs(setpoint.qdd) <= limits.acceleration * (1.0 + 1e-9)).all()
        assert (np.abs(setpoint.qdd - before.qdd) <= limits.jerk * dt * (1.0 + 1e-6)).all()
        # A jerk within its limit cannot make them differ more from what a jerk of zero gives.
        speed = 0.5 * (before.qd + setpoint.qd)
        most = limits.jerk * dt**3 / 6.0 + 1e-9
        assert (np.abs(setpoint.q - before.q - speed * dt) <= most).all()


SEEDS = st.integers(0, 2**32 - 1)
SEQUENCES = st.lists(st.sampled_from(EVENTS), min_size=10, max_size=40)


@pytest.mark.parametrize(("name", "period"), [("mara", 0.01), ("panda", 0.02), ("mara", 0.05)])
@settings(max_examples=8)
@given(seed=SEEDS, events=SEQUENCES)
def test_no_sequence_leaves_the_limits_or_collides(
    name: str, period: float, seed: int, events: list[str]
) -> None:
    _live_through(World(robot_model(name), period, seed), events)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "period"), [("mara", 0.01), ("ur5", 0.01), ("panda", 0.002)])
@settings(max_examples=30)
@given(seed=SEEDS, events=SEQUENCES)
def test_nor_do_many_sequences(name: str, period: float, seed: int, events: list[str]) -> None:
    _live_through(World(robot_model(name), period, seed), events)


def _live_through(world: World, events: list[str]) -> None:
    """Let events happen and then a stop, and check that nothing collides, at the set-points or between them."""
    for event in events:
        world.event(event)
    world.filter.stop("the end")
    for _ in range(int(LONGEST_STOP / world.period) + 1):
        world.tick()
    assert world.filter.mode is Mode.STOPPED
    path = np.array(world.path)
    way = path[1:] - path[:-1]
    between = [path[:-1] + part * way for part in (0.25, 0.5, 0.75)]
    assert not CoalChecker(world.robot).check(np.vstack([path, *between])).any()
