"""Speed of the dynamic backends, compared with their engines alone, with each other and with other packages; prints Markdown.

`--no-training` leaves out the trainings, which take about five minutes.
"""

from __future__ import annotations

import argparse
import resource
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
from mujoco.rollout import Rollout
from speed import PEERS, batch, single
from timing import rates, row
from training import print_dynamic_training

import gym_mara  # noqa: F401 - registers the environments
from gym_mara.backends.dart.arm import DartArm
from gym_mara.backends.dart.backend import DartBackend
from gym_mara.backends.mujoco.backend import MujocoBackend
from gym_mara.robot import RobotModel

ENV_ID = "gym_mara/MARACollisionOrient-v0"
PEER_ID = "gym_mara/MARA-v0"
"""The environment whose task is that of the other packages: bring the end effector to a position."""
ARMS = 64
BARE = "mujoco.rollout alone, one thread"
RATIOS = (
    ("mujoco, one thread", "dart, one process", "at least 3"),
    ("mujoco, one thread", BARE, "at least 0.8"),
    ("mujoco, two threads", "mujoco, one thread", "at least 1.8"),
    ("dart, two processes", "dart, one process", ""),
)


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


def bare_rollouts() -> Callable[[], int]:
    """mujoco.rollout alone in one thread, with the model, states, commands and number of steps of `batch`."""
    envs: Any = gymnasium.make_vec(ENV_ID, num_envs=ARMS, backend="mujoco", threads=1)
    backend = envs.unwrapped.simulation.backend
    assert isinstance(backend, MujocoBackend)
    stepper, run_on = backend._stepper, backend._stepper.run
    periods: list[tuple[Any, ...]] = []

    def record(models: Any, states: Any, warmstarts: Any, commands: Any) -> Any:
        if commands.shape[1] > 1:  # otherwise it looks for contacts
            periods.append((models, states.copy(), warmstarts.copy(), commands.copy()))
        return run_on(models, states, warmstarts, commands)

    stepper.run = record  # type: ignore[method-assign, assignment]
    envs.reset(seed=0)
    envs.action_space.seed(0)
    for _ in range(10):
        envs.step(envs.action_space.sample())
    data, rollout = [mujoco.MjData(backend._model)], Rollout(nthread=0)

    def run() -> int:
        for models, states, warmstarts, commands in periods:
            options = {"initial_warmstart": warmstarts, "nstep": commands.shape[1]}
            rollout.rollout(models, data, states, commands, skip_checks=True, **options)
        return ARMS * len(periods)

    return run


def print_step() -> None:
    """Compare one environment with the physics steps that it contains."""
    env = gymnasium.make(ENV_ID, backend="dart")
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(200)]
    measured = rates({"bare": bare_steps(actions), "env": single(ENV_ID, backend="dart")})
    print("\n## One dynamic environment, compared with its world.step() calls\n")
    row("", "steps per second", "relative time")
    row("---", "---", "---")
    row("world.step() alone, 20 calls per step", f"{measured['bare']:,.0f}", "1.00")
    ratio = measured["bare"] / measured["env"]
    row(f"{ENV_ID}, backend='dart'", f"{measured['env']:,.0f}", f"{ratio:.2f}")


def print_batches() -> None:
    """Compare 64 arms in both engines, in one thread or process and in two, and MuJoCo alone."""
    functions = {
        "dart, one process": batch(ENV_ID, ARMS, backend="dart", workers=1),
        "dart, two processes": batch(ENV_ID, ARMS, backend="dart", workers=2),
        "mujoco, one thread": batch(ENV_ID, ARMS, backend="mujoco", threads=1),
        "mujoco, two threads": batch(ENV_ID, ARMS, backend="mujoco", threads=2),
        BARE: bare_rollouts(),
    }
    measured = rates(functions)
    print(f"\n## {ARMS} arms\n")
    row("", "steps per second")
    row("---", "---")
    for name, rate in measured.items():
        row(name, f"{rate:,.0f}")
    print()
    row("", "ratio", "target")
    row("---", "---", "---")
    for one, other, target in RATIOS:
        row(f"{one} / {other}", f"{measured[one] / measured[other]:.2f}", target)


def print_peers() -> None:
    """Compare one dynamic environment with the other packages that are installed."""
    ours = {f"{PEER_ID}, backend='{name}'": name for name in ("mujoco", "dart")}
    functions = {name: single(PEER_ID, backend=backend) for name, backend in ours.items()}
    for module, env_id in PEERS.items():
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                gymnasium.register_envs(__import__(module))
                functions[env_id] = single(env_id)
        except Exception as error:
            print(f"\n{env_id} cannot run here: {type(error).__name__} {error}")
    measured = rates(functions)
    print("\n## One dynamic environment, compared with other packages\n")
    row("environment", "steps per second", *(f"{name} is faster by" for name in ours.values()))
    row("---", "---", "---", "---")
    for name, rate in measured.items():
        row(name, f"{rate:,.0f}", *(f"{measured[one] / rate:.2f}" for one in ours))
    print("\nTarget: mujoco is faster than the other packages by at least 4.")


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


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--no-training", action="store_true", help="do not measure the trainings")
    arguments = parser.parse_args()
    print_step()
    print_batches()
    print_peers()
    print_memory()
    print_energy()
    if not arguments.no_training:
        print_dynamic_training()


if __name__ == "__main__":
    main()
