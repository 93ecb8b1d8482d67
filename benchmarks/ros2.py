"""How fast the ROS 2 part is: the safety filter.

    python benchmarks/ros2.py [--seconds 20]

A time is that of one call on the clock of the wall. On a machine with other work its percentiles are of that work as well, so the
time of the CPU stands beside it.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from numpy.typing import NDArray

from gym_mara.collision import CollisionChecker, make_checker
from gym_mara.collision.free_poses import ROOM
from gym_mara.robot import RobotModel
from gym_mara.robot.joint_ranges import reachable_range
from gym_mara.ros2.arm import ArmState
from gym_mara.ros2.motion import MotionLimits
from gym_mara.ros2.safety import Mode, SafetyFilter

Floats = NDArray[np.float64]
RATE = 100.0
"""Ticks of the filter in a second."""
POLICY_RATE = 20.0
"""Commands in a second."""


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--robot", default="mara", help="the arm (mara)")
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="of simulated motion for each line (60)"
    )
    arguments = parser.parse_args()
    safety_filter(RobotModel.load(arguments.robot), arguments.seconds)


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
    rng, exact = np.random.default_rng(0), make_checker("coal", robot)
    free = exact.with_margin(np.full(robot.num_joints, ROOM)) or exact
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


if __name__ == "__main__":
    main()
