"""How long an arm of one's own takes to load, and how many steps a CPU second it does; prints Markdown.

python benchmarks/arms.py arm.urdf other.urdf --ee-frame tool0
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import gymnasium

import gym_mara
from gym_mara.robot import RobotModel

ACTIONS = 50


def seconds_to_load(urdf: str, ee_frame: str | None, convex_hulls: bool) -> float:
    """The time in which the robot is loaded, s."""
    start = time.perf_counter()
    RobotModel.load(urdf, ee_frame, convex_hulls=convex_hulls)
    return time.perf_counter() - start


def rate(robot: RobotModel, backend: str, seconds: float) -> float:
    """Steps a CPU second with random actions."""
    env: Any = gymnasium.make("gym_mara/MARA-v0", robot=robot, backend=backend)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(ACTIONS)]
    steps, start = 0, time.process_time()
    while (used := time.process_time() - start) < seconds:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
            steps += 1
            if time.process_time() - start > seconds:
                break
    env.close()
    return steps / used


def main() -> None:
    """Measure every arm, with its meshes and with their convex hulls."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("urdf", nargs="+")
    parser.add_argument("--ee-frame", help="the end-effector link, the same for every file")
    parser.add_argument("--seconds", type=float, default=3.0, help="CPU time of each rate, s")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    print(
        f"gym_mara {gym_mara.__version__}; load in s, first and second time; steps a CPU second.\n"
    )
    print("| arm | meshes | load | again | pinocchio | dart |\n|---|---|---:|---:|---:|---:|")
    for urdf in options.urdf:
        for hulls in (False, True):
            first, second = (seconds_to_load(urdf, options.ee_frame, hulls) for _ in range(2))
            robot = RobotModel.load(urdf, options.ee_frame, convex_hulls=hulls)
            kinematic, dart = (
                rate(robot, backend, options.seconds) for backend in ("pinocchio", "dart")
            )
            name, kind = Path(urdf).stem, "convex hulls" if hulls else "as they are"
            print(
                f"| {name} | {kind} | {first:.2f} | {second:.2f} | {kinematic:,.0f} | {dart:,.0f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
