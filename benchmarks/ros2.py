"""How fast and how exact the ROS 2 part is: the safety filter, the simulated arm, and a policy that is deployed on it.

    python benchmarks/ros2.py [--parts filter sim deploy] [--seconds 60] [--targets 20] [--env MARAReach-v0]

The time of the filter is that of one call on the clock of the wall. On a machine with other work its percentiles are of that work as
well, so the time of the CPU stands beside it. The simulated arm and the policy are two processes, each on one core, in a ROS domain
of this machine alone. The policy is the pretrained one of an environment; it gets a new random target every eight seconds, to which there is a
straight joint move without a collision, as in the episodes of the environment.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gym_mara.collision import CollisionChecker, make_checker
from gym_mara.collision.free_poses import FreePoses
from gym_mara.collision.room import room_checker
from gym_mara.deploy import OnnxPolicy
from gym_mara.pretrained import pretrained_file
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.ros2.arm import ArmState
from gym_mara.ros2.safety.filter import Mode, SafetyFilter
from gym_mara.ros2.safety.motion import MotionLimits
from gym_mara.rotations import angle_between

if TYPE_CHECKING:
    from gym_mara.ros2.deploy import Deployment

Floats = NDArray[np.float64]
RATE = 100.0
"""Ticks of the filter in a second."""
POLICY_RATE = 20.0
"""Commands in a second."""
PARTS = ("filter", "sim", "deploy")
HOLD = 8.0
"""How long a target stays, s: twice the length of an episode of MARAReach-v0, because the filter limits the acceleration, and a
deployed policy sees the arm late."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--robot", default="mara", help="the arm of the filter (mara)")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--env", default="MARAReach-v0", help="of the policy (MARAReach-v0)")
    parser.add_argument("--targets", type=int, default=20, help="of the policy, for a profile (20)")
    parser.add_argument(
        "--seconds",
        type=float,
        default=60.0,
        help="of motion for each line of the filter and the simulation (60)",
    )
    arguments = parser.parse_args()
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(1 + os.getpid() % 101)
    if "filter" in arguments.parts:
        safety_filter(RobotModel.load(arguments.robot), arguments.seconds)
    if "sim" in arguments.parts:
        simulated_arm(arguments.seconds)
    if "deploy" in arguments.parts:
        deployment(arguments.env, arguments.targets)


def safety_filter(robot: RobotModel, seconds: float) -> None:
    """Print how long a tick of the safety filter takes while the arm moves to random free configurations."""
    for name, checker in (
        ("kinematic checks", None),
        ("with the collision checks", make_checker("coal", robot)),
    ):
        for way, step in (("targets anywhere", np.inf), ("steps of a policy", 0.1)):
            wall, cpu = _ticks(robot, checker, int(seconds * RATE), step)
            print(
                f"filter: {_percentiles(wall)}, {name} ({way}, {len(wall)} ticks in motion; CPU: {_percentiles(cpu)})",
                flush=True,
            )


def _ticks(
    robot: RobotModel, checker: CollisionChecker | None, ticks: int, step: float
) -> tuple[Floats, Floats]:
    """The times of the ticks in motion on the clocks of the wall and of the CPU, s.

    Args:
        robot: the arm.
        checker: of the filter.
        ticks: how many, with those at rest.
        step: how far a command is from where the arm is at most, rad: a new one at POLICY_RATE. Where it is infinite, the
            target is anywhere and changes each second.
    """
    rng, free = np.random.default_rng(0), room_checker(robot)
    low, high = reachable_range(robot)
    safety = SafetyFilter(robot, 1.0 / RATE, MotionLimits.of(robot), checker=checker)
    q, still, wall, cpu = robot.home, np.zeros(robot.num_joints), [], []
    safety.start(ArmState(q, still, None, 0.0, 0.0), 0.0)
    command = q
    for tick in range(1, ticks + 1):
        now = tick / RATE
        if tick % int(RATE / (1.0 if step == np.inf else POLICY_RATE)) == 1:
            command = _free(
                rng, free, np.maximum(low, q - step), np.minimum(high, q + step), command
            )
        state = ArmState(q, still, None, now, 0.0)
        begin, begin_cpu = time.perf_counter(), time.thread_time()
        setpoint = safety.step(now, state, command, now)
        end_cpu, end = time.thread_time(), time.perf_counter()
        q = setpoint.q
        if safety.mode is Mode.STOPPED:
            safety.resume(ArmState(q, still, None, now, 0.0), now)
        elif setpoint.qd.any():
            wall.append(end - begin)
            cpu.append(end_cpu - begin_cpu)
    return np.array(wall), np.array(cpu)


def _free(
    rng: np.random.Generator,
    checker: CollisionChecker,
    low: Floats,
    high: Floats,
    otherwise: Floats,
) -> Floats:
    """A random free configuration; where none is found soon, another one."""
    candidates = rng.uniform(low, high, (20, len(low)))
    good = np.flatnonzero(~checker.check(candidates))
    return candidates[good[0]] if len(good) else otherwise


def _percentiles(seconds: Floats) -> str:
    p50, p99 = np.percentile(1e6 * seconds, [50, 99])
    return f"p50 {p50:.0f} µs, p99 {p99:.0f} µs"


@contextmanager
def _simulation(*options: str) -> Iterator[subprocess.Popen[str]]:
    """A simulated MARA as a process on the last core."""
    command = [sys.executable, "-m", "gym_mara.cli", "ros2", "sim", *options]
    core = {max(os.sched_getaffinity(0))}
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, preexec_fn=lambda: os.sched_setaffinity(0, core)
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        if not line.startswith("ready"):
            raise SystemExit(f"the simulated arm did not start: {line}")
        yield process
    finally:
        process.kill()
        process.wait()


def simulated_arm(seconds: float) -> None:
    """Print how many ticks a simulated arm misses in real time."""
    for backend in ("dart", "mujoco"):
        with _simulation("--backend", backend, "--seconds", str(seconds)) as process:
            rest, _ = process.communicate()
        missed = rest.split()[0] if "missed" in rest else "0"
        print(
            f"sim: {backend}, one core, {50 * seconds:.0f} ticks at 50 Hz: {missed} missed",
            flush=True,
        )


def deployment(env: str, targets: int) -> None:
    """Print how punctual a deployed policy is, and how near it comes to random targets, with each profile."""
    from gym_mara.ros2.deploy import Deployment

    robot = RobotModel.load("mara")
    policy = OnnxPolicy(pretrained_file(env))
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    for profile in ("trajectory", "forward", "mara-2019"):
        with _simulation("--backend", "dart"):
            deployed = Deployment(policy, None, {"profile": profile, "live": True}, _quiet)
            try:
                errors, angles, stops = _errors(deployed, robot, targets)
                found = deployed.diagnostics
            finally:
                deployed.close()
        ticks = found.setpoints
        late = [1e3 * value for value in (*ticks.lateness, *found.lateness)]
        angle = f"{_quantiles(angles)} degrees, " if len(angles) else ""
        print(
            f"deploy: {profile}, {targets} targets of {env} on dart: error {_quantiles(errors)} mm, {angle}"
            f"{len(stops)} stops{stops or ''}; set-points at {RATE:.0f} Hz: late by p50 {late[0]:.2f}, p99 {late[1]:.2f}, at most {late[2]:.2f} ms, "
            f"{ticks.missed} of {ticks.ticks} missed; actions at 50 Hz: late by p50 {late[3]:.2f}, p99 {late[4]:.2f} ms, "
            f"{found.missed_ticks} of {found.steps} missed",
            flush=True,
        )


def _quantiles(values: Floats) -> str:
    return f"p50 {np.median(values):.4f}, p95 {np.quantile(values, 0.95):.4f}"


def _quiet(line: str) -> None:
    """What a deployment says of itself is not printed."""


def _errors(
    deployed: Deployment, robot: RobotModel, targets: int
) -> tuple[Floats, Floats, list[str]]:
    """The distance to each target at its end, mm, the angle, degrees, and why the filter stopped the arm, each time."""
    from gym_mara.ros2.deploy import Target

    rng, poses = np.random.default_rng(0), FreePoses(robot)
    errors, angles, stops = [], [], []
    for _ in range(targets):
        here = np.clip(deployed.backend.state.q[0], robot.lower, robot.upper)
        _, position, quaternion = poses.draw_move(rng, here)
        orientation = tuple(quaternion.tolist()) if deployed.oriented else None
        deployed.aim(Target(tuple(position.tolist()), orientation)).result()
        deployed.run(HOLD)
        if (status := deployed.diagnostics.status).startswith("stopped"):
            stops.append(status)
            deployed.resume()
            continue
        state = deployed.backend.state
        errors.append(1e3 * float(np.linalg.norm(state.ee_position[0] - position)))
        if deployed.oriented:
            angles.append(float(np.degrees(angle_between(state.ee_quaternion[0], quaternion))))
    return np.array(errors or [np.nan]), np.array(angles), stops


if __name__ == "__main__":
    main()
