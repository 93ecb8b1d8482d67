"""Speed of the dynamic backend, compared with DART alone and with other packages, and its energy drift; prints Markdown."""

from __future__ import annotations

import resource
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from speed import PEERS, batch, single
from timing import rates, row

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.backends.dart.arm import DartArm
from gym_mara.backends.dart.backend import DartBackend
from gym_mara.robot import RobotModel

ENV_ID = "gym_mara/MARACollisionOrient-v0"


def bare_steps(actions: Any) -> Callable[[], int]:
    """DART's world.step() alone, with the same states, commands and number of calls as in `dynamic`."""
    env = gymnasium.make(ENV_ID, backend="dart")
    backend = env.unwrapped.simulation.backend  # type: ignore[attr-defined]
    assert isinstance(backend, DartBackend)
    moved, run_on = backend.arms[0], backend.arms[0].run
    periods = []

    def record(velocities: Any) -> Any:
        periods.append((moved.q, moved.qd, velocities))
        return run_on(velocities)

    moved.run = record  # type: ignore[method-assign]
    env.reset(seed=0)
    for action in actions:
        env.step(action)
    arm = DartArm(RobotModel.load("mara"))

    def run() -> int:
        command, step = arm.skeleton.setCommands, arm.world.step
        for q, qd, velocities in periods:
            arm.set_state(q, qd)
            for velocity in velocities:
                command(velocity)
                step()
        return len(periods)

    return run


def dynamic(env_id: str = ENV_ID, **options: Any) -> Callable[[], int]:
    """Steps of one dynamic environment through gymnasium.make, with random actions."""
    return single(env_id, backend="dart", **options)


def print_step() -> None:
    """Compare one environment with the physics steps that it contains."""
    env = gymnasium.make(ENV_ID, backend="dart")
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(200)]
    measured = rates({"bare": bare_steps(actions), "env": dynamic()})
    print("\n## One dynamic environment, compared with its world.step() calls\n")
    row("", "steps per second", "relative time")
    row("---", "---", "---")
    row("world.step() alone, 20 calls per step", f"{measured['bare']:,.0f}", "1.00")
    ratio = measured["bare"] / measured["env"]
    row(f"{ENV_ID}, backend='dart'", f"{measured['env']:,.0f}", f"{ratio:.2f}")


def print_workers() -> None:
    """Compare the same arms in one process and in two."""
    functions = {
        str(workers): batch(ENV_ID, 64, backend="dart", workers=workers) for workers in (1, 2)
    }
    measured = rates(functions)
    print("\n## 64 arms in worker processes\n")
    row("workers", "steps per second", "relative")
    row("---", "---", "---")
    for workers, rate in measured.items():
        row(workers, f"{rate:,.0f}", f"{rate / measured['1']:.2f}")


def print_peers() -> None:
    """Compare one dynamic environment with the other packages that are installed."""
    functions = {f"{ENV_ID}, backend='dart'": dynamic()}
    for module, env_id in PEERS.items():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                gymnasium.register_envs(__import__(module))
                functions[env_id] = single(env_id)
        except Exception as error:
            print(f"\n{env_id} cannot run here: {type(error).__name__} {error}")
    measured = rates(functions)
    ours = next(iter(measured.values()))
    print("\n## One dynamic environment, compared with other packages\n")
    row("environment", "steps per second", "ours is faster by")
    row("---", "---", "---")
    for name, rate in measured.items():
        row(name, f"{rate:,.0f}", f"{ours / rate:.2f}")


def _resident() -> float:
    """The memory of this process, MB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def print_memory() -> None:
    """Print the memory of an additional environment."""
    if not Path("/proc/self/statm").is_file():
        print("\nMemory is measured on Linux only.")
        return
    envs, held = [], []
    for _ in range(21):
        env = gymnasium.make(ENV_ID, backend="dart")
        env.reset(seed=0)
        env.step(env.action_space.sample())
        envs.append(env)
        held.append(_resident())
    print(f"\nMemory of each environment after the first: {(held[-1] - held[0]) / 20:.1f} MB")


def print_energy() -> None:
    """Print the energy drift of an arm without motors over 10 s, in free space."""
    print("\n## Energy drift of an arm without motors over 10 s, without contact or friction\n")
    row(
        "start",
        "physics step, ms",
        "largest kinetic energy, J",
        "largest drift, J",
        "largest drift in the first second, J",
    )
    row(*["---"] * 5)
    robot = RobotModel.load("mara")
    starts = {
        "nearly hanging": (0.3, 2.6, 0.3, 0.2, 0.3, 0.0),
        "nearly upright": (0.5, 1.0, 0.5, 0.3, -0.5, 0.0),
    }
    for name, start in starts.items():
        for step in (1e-3, 1e-4):
            arm = DartArm(robot, step, None, servo=False)
            arm.reset(np.array(start))
            kinetic, total = energies(arm, 10.0)
            drift = np.abs(total - total[0])
            first = drift[: round(1.0 / step)].max()
            row(
                name,
                f"{1000 * step:g}",
                f"{kinetic.max():.1f}",
                f"{drift.max():.2f}",
                f"{first:.2f}",
            )


def energies(arm: DartArm, seconds: float) -> tuple[Any, Any]:
    """The kinetic and the total energy of an arm without motors, at each physics step, J."""
    kinetic, potential = [], []
    for _ in range(round(seconds / arm.physics_step)):
        arm.world.step()
        kinetic.append(arm.skeleton.computeKineticEnergy())
        potential.append(arm.skeleton.computePotentialEnergy())
    return np.array(kinetic), np.array(kinetic) + np.array(potential)


if __name__ == "__main__":
    print_step()
    print_workers()
    print_peers()
    print_memory()
    print_energy()
