"""`gym-mara ros2 sim` and `deploy` as two processes, of which either is killed, frozen, delayed or told nonsense at random."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy")

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger

from gym_mara.collision.coal import CoalChecker
from gym_mara.pretrained import pretrained_file
from gym_mara.ros2.messages import SENSOR_DATA
from tests.helpers import robot_model, started
from tests.ros2.peers import Peer, eventually

HOLD = 1.0
"""Within this time after a fault the arm rests, s: what the watchdogs take, and a deceleration."""
REST = 0.03
"""rad/s."""
TARGETS = ((-0.4, 0.095, 0.87), (-0.3, 0.4, 0.9), (-0.35, -0.3, 0.85))
"""Positions that MARA reaches, m."""
SILENT = "the arm's state is", "the arm does not follow"
"""Why an arm stops whose states do not come."""
BEFORE = "collision ahead", "no set-point was sent"
"""Why it may have stopped just before: on its way, and on a machine that is busy."""
MARA = robot_model("mara")


class Stage:
    """A simulated arm, a policy that moves it, and somebody who watches and disturbs."""

    def __init__(self, stack: ExitStack, rng: np.random.Generator) -> None:
        self._stack, self.rng = stack, rng
        self.peer = Peer("watcher")
        stack.callback(self.peer.close)
        self.traces: list[list[Any]] = []
        self.peer.ros.node.create_subscription(JointState, "/joint_states", self._see, SENSOR_DATA)
        self.diagnostics = self.peer.heard(DiagnosticArray, "/diagnostics")
        self.targets = self.peer.publisher(PoseStamped, "/gym_mara/target")
        self.start_sim()
        self.start_deploy()

    def _see(self, message: Any) -> None:
        counts = len(message.position), len(message.velocity)
        if tuple(message.name) == MARA.joint_names and counts == (6, 6):
            self.traces[-1].append((time.monotonic(), message.position, message.velocity))

    def _started(self, *arguments: str) -> subprocess.Popen[str]:
        process = self._stack.enter_context(started("-m", "gym_mara.cli", "ros2", *arguments))
        assert process.stdout is not None
        line = "started"
        while line and not line.startswith("ready"):
            line = process.stdout.readline()
        assert line, arguments
        return process

    def start_sim(self) -> None:
        self.traces.append([])
        self.sim = self._started("sim", "--backend", "mujoco", "--set", "servo_gain=20")

    def start_deploy(self) -> None:
        profile = self.rng.choice(["trajectory", "forward", "mara-2019"])
        policy = str(pretrained_file("MARAReach-v0"))
        self.deploy = self._started("deploy", policy, "--live", "--profile", str(profile))
        self.diagnostics.clear()

    @property
    def speed(self) -> float:
        """The highest joint velocity of the last state, rad/s."""
        return float(np.abs(self.traces[-1][-1][2]).max()) if self.traces[-1] else 0.0

    @property
    def status(self) -> str:
        """What the deployment says of itself."""
        return str(self.diagnostics[-1].status[0].message) if self.diagnostics else ""

    def move(self) -> None:
        """Give targets until the arm moves."""
        end = time.monotonic() + 10.0
        while self.speed < 0.1:
            assert time.monotonic() < end, f"the arm does not move: {self.status}"
            message = PoseStamped()
            point = message.pose.position
            point.x, point.y, point.z = TARGETS[self.rng.integers(len(TARGETS))]
            self.targets.publish(message)
            if self.status.startswith("stopped"):
                self.resume()
            time.sleep(0.4)

    def resume(self) -> None:
        self.peer.call(Trigger, "/gym_mara/resume")
        self.diagnostics.clear()

    def rests(self) -> None:
        """Check that the arm comes to rest in time, and stays there."""
        time.sleep(HOLD)
        q = np.array(self.traces[-1][-1][1])
        assert self.speed < REST
        time.sleep(0.2)
        np.testing.assert_allclose(self.traces[-1][-1][1], q, atol=0.01)

    def says_why(self, *reasons: str) -> None:
        """Wait until the deployment says that it has stopped for one of these reasons."""
        try:
            eventually(lambda: any(f"stopped: {reason}" in self.status for reason in reasons))
        except AssertionError:
            pytest.fail(f"it says {self.status!r}, and none of {reasons}")


def _kill_deploy(stage: Stage) -> None:
    stage.deploy.kill()
    stage.rests()
    stage.start_deploy()


def _kill_sim(stage: Stage) -> None:
    stage.sim.kill()
    stage.says_why(*SILENT, *BEFORE)
    stage.start_sim()


def _freeze_deploy(stage: Stage) -> None:
    os.kill(stage.deploy.pid, signal.SIGSTOP)
    stage.rests()
    stage.diagnostics.clear()
    os.kill(stage.deploy.pid, signal.SIGCONT)
    # Where the last set-points had come to rest already, nothing has to stop.
    eventually(lambda: stage.status.startswith(("moves", "has reached", "stopped: ")))


def _freeze_sim(stage: Stage) -> None:
    os.kill(stage.sim.pid, signal.SIGSTOP)
    time.sleep(float(stage.rng.uniform(0.3, 1.0)))
    os.kill(stage.sim.pid, signal.SIGCONT)
    stage.says_why(*SILENT, *BEFORE)
    stage.rests()


def _delay(stage: Stage) -> None:
    """Short pauses of either side: the arm goes on, or stops and says why."""
    process = [stage.sim, stage.deploy][stage.rng.integers(2)]
    for _ in range(4):
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(float(stage.rng.uniform(0.02, 0.06)))
        os.kill(process.pid, signal.SIGCONT)
        time.sleep(0.05)


def _nonsense(stage: Stage) -> None:
    """Messages that nobody may obey, to both sides."""
    rng, names = stage.rng, list(MARA.joint_names)
    forward = "/forward_position_controller/commands"
    commands = stage.peer.publisher(Float64MultiArray, forward)
    states = stage.peer.publisher(JointState, "/joint_states")
    for _ in range(10):
        for state in (
            JointState(name=names, position=[float("nan")] * 6),
            JointState(name=names[:3], position=[0.0] * 3),
            JointState(name=["other"], position=[0.0]),
            JointState(name=names, position=rng.uniform(-1, 1, 4).tolist()),
        ):
            states.publish(state)
        for values in ([float("inf")] * 6, [0.1] * 3, []):
            commands.publish(Float64MultiArray(data=values))
        far = PoseStamped()
        far.pose.position.x = float(rng.choice([np.nan, 9.0]))
        stage.targets.publish(far)
        time.sleep(0.01)
    for publisher in (commands, states):
        stage.peer.ros.node.destroy_publisher(publisher)


FAULTY = (_kill_deploy, _kill_sim, _freeze_deploy, _freeze_sim, _delay, _nonsense)


@pytest.fixture
def stage(ros_domain: int) -> Iterator[Stage]:
    with ExitStack() as stack:
        seed = int(np.random.SeedSequence().generate_state(1)[0])
        print(f"seed {seed}")  # pytest shows it where the test fails
        yield Stage(stack, np.random.default_rng(seed))


@pytest.mark.parametrize(
    "faults",
    [pytest.param(6, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.nightly)],
)
def test_whatever_fails_the_arm_holds_and_stays_within_its_limits(
    stage: Stage, faults: int
) -> None:
    for number in range(faults):
        stage.move()
        FAULTY[number % len(FAULTY)](stage)
    stage.move()
    assert sum(map(len, stage.traces)) > 50 * faults
    for trace in stage.traces:
        _, q, qd = (np.array(values) for values in zip(*trace, strict=True))
        assert (q >= MARA.lower - 0.01).all()
        assert (q <= MARA.upper + 0.01).all()
        assert (np.abs(qd) <= 1.05 * MARA.velocity_limit).all()
        assert not CoalChecker(MARA).check(q).any()
