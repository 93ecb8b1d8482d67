"""Environment steps per second, compared with Pinocchio alone and with other packages; prints Markdown.

The floor is what Pinocchio alone takes for the configurations that the environment visits: Coal's batched collision check on all
cores, and forward kinematics. Every figure is the best of several repetitions. Figures that are compared are measured in turn, because on a shared machine only ratios within one run are meaningful.
"""

from __future__ import annotations

import argparse
import os
import platform
import warnings
from collections.abc import Callable
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from timing import rates, row
from training import print_training

import gym_mara
from gym_mara.robot import RobotModel
from gym_mara.tasks import PAPER_TASKS

NUM_ENVS = (1, 16, 256, 1024)
PEERS = {"panda_gym": "PandaReach-v3", "gymnasium_robotics": "FetchReach-v4"}


def single(env_id: str, **options: Any) -> Callable[[], int]:
    """Steps of one environment with random actions, made by gymnasium.make."""
    env = gymnasium.make(env_id, **options)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(200)]

    def run() -> int:
        for action in actions:
            _, _, terminated, truncated, _ = env.step(action)
            if terminated or truncated:
                env.reset()
        return len(actions)

    return run


def batch(
    env_id: str, num_envs: int, by_samples: bool = False, **options: Any
) -> Callable[[], int]:
    """Steps of the native vector environment with random actions; `by_samples` checks every path by samples."""
    envs: Any = gymnasium.make_vec(env_id, num_envs=num_envs, **options)
    if by_samples:
        envs.unwrapped.simulation.backend._with_margin = None
    envs.reset(seed=0)
    envs.action_space.seed(0)
    actions = [envs.action_space.sample() for _ in range(10)]

    def run() -> int:
        for action in actions:
            envs.step(action)
        return num_envs * len(actions)

    return run


def configurations(num_envs: int) -> NDArray[np.float64]:
    """The configurations that `batch` visits: random actions, clipped to the joint limits."""
    robot = RobotModel.load("mara")
    envs = gymnasium.make_vec("gym_mara/MARA-v0", num_envs=num_envs)
    envs.action_space.seed(0)
    actions = np.concatenate([envs.action_space.sample() for _ in range(max(1, 200 // num_envs))])
    return np.clip(actions.astype(np.float64), robot.lower, robot.upper)


def floor(q: NDArray[np.float64]) -> Callable[[], int]:
    """Coal's batched check on all cores, and Pinocchio's forward kinematics, which has only calls for one configuration."""
    robot = RobotModel.load("mara")
    model, data, frame = robot.model, robot.model.createData(), robot.ee_frame_id
    threads = len(os.sched_getaffinity(0))
    pool = pin.BroadPhaseManagerPool_DynamicAABBTreeCollisionManager(model, robot.geometry, threads)
    columns = np.asfortranarray(q.T)

    def run() -> int:
        pin.computeCollisionsInParallel(threads, pool, columns, True, False)
        for configuration in q:
            pin.forwardKinematics(model, data, configuration)
            pin.updateFramePlacement(model, data, frame)
        return len(q)

    return run


def print_throughput() -> None:
    """Compare every environment, with every number of arms, with the floor."""
    print("\n## Steps per second, random actions\n")
    row("environments", *PAPER_TASKS, "floor", "MARA / floor", "MARACollisionOrient / floor")
    row(*["---"] * (len(PAPER_TASKS) + 4))
    for num_envs in NUM_ENVS:
        functions = {name: batch(f"gym_mara/{name}", num_envs) for name in PAPER_TASKS}
        measured = rates({**functions, "floor": floor(configurations(num_envs))})
        ratios = (measured[name] / measured["floor"] for name in (PAPER_TASKS[0], PAPER_TASKS[-1]))
        row(
            num_envs,
            *(f"{rate:,.0f}" for rate in measured.values()),
            *(f"{ratio:.2f}" for ratio in ratios),
        )


def print_travelling() -> None:
    """Compare arms with a limited joint speed with teleporting arms, and measure the gain of checking a path once."""
    travelling: dict[str, Any] = {"max_joint_velocity": 1.57}
    measured = rates(
        {
            "teleporting": batch("gym_mara/MARA-v0", 64),
            "limited to 1.57 rad/s": batch("gym_mara/MARA-v0", 64, **travelling),
            "the same, every path checked by samples": batch(
                "gym_mara/MARA-v0", 64, True, **travelling
            ),
        }
    )
    print("\n## 64 arms with a limited joint speed\n")
    row("joints", "steps per second", "relative to teleporting")
    row("---", "---", "---")
    for name, rate in measured.items():
        row(name, f"{rate:,.0f}", f"{rate / measured['teleporting']:.2f}")


def print_peers() -> None:
    """Compare one environment, made by gymnasium.make, with the other packages that are installed."""
    functions = {}
    for module, env_id in PEERS.items():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                gymnasium.register_envs(__import__(module))
                functions[env_id] = single(env_id)
        except Exception as error:
            print(f"\n{env_id} cannot run here: {type(error).__name__} {error}")
    ours = "gym_mara/MARACollisionOrient-v0"
    others: dict[str, dict[str, Any]] = {
        "max_joint_velocity=1.57": {"max_joint_velocity": 1.57},
        "backend='dart'": {"backend": "dart"},
        "backend='mujoco'": {"backend": "mujoco"},
    }
    for name, options in others.items():
        functions[f"{ours}, {name}"] = single(ours, **options)
    measured = rates({ours: single(ours), **functions})
    print("\n## One environment through gymnasium.make\n")
    row("environment", "steps per second", "ours is faster by")
    row("---", "---", "---")
    for name, rate in measured.items():
        row(name, f"{rate:,.0f}", f"{measured[ours] / rate:.1f}")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--no-training", action="store_true", help="do not measure the training")
    arguments = parser.parse_args()
    libraries = ", ".join(f"{name} {version(name)}" for name in ("gymnasium", "numpy", "pin"))
    print(
        f"gym_mara {gym_mara.__version__}, {libraries}, Python {platform.python_version()}, "
        f"{len(os.sched_getaffinity(0))} cores"
    )
    print_throughput()
    print_travelling()
    print_peers()
    if not arguments.no_training:
        print_training()


if __name__ == "__main__":
    main()
