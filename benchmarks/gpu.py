"""Speed of the backend "warp" on a GPU of NVIDIA: dynamics, kinematics, training, memory and compilation; prints Markdown.

python benchmarks/gpu.py --out gpu.md
python benchmarks/gpu.py --device cpu --arms 8 --training-arms 8 --seconds 0.5

The second command tries the script where no GPU is. It needs the extras `warp` and, for the training, `rsl`. Each measurement
runs in a process of its own: if one fails or takes too long, that is printed, and the others are still made. Kernels are
compiled anew, into a folder for this run. On an H100 all of it takes about eight minutes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from timing import REPETITIONS, rates

import gym_mara
from gym_mara.envs import MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs

TASK = "MARACollision-v0"
ARMS = (1024, 8192, 32768, 65536)
TRAVELLING = {"max_joint_velocity": 1.57}
LIBRARIES = ("gymnasium", "numpy", "torch", "warp-lang", "mujoco", "mujoco-warp", "rsl-rl-lib")
AT_EACH, AT_ONE = ("dynamics", "kinematics"), ("dynamics in contact", "travelling")
RATE, BARE, RATIO = "steps/s", "bare CUDA graph, steps/s", "relative to the bare graph"
MEMORY, START = "device memory, MB", "from the start to the first step, s"
CONTACTS = "points of contact an arm"
FAILED = "failed"
TARGETS = {
    ("dynamics", 32768, RATE): "at least 1,000,000",
    ("dynamics", 32768, RATIO): "at least 0.7",
    ("kinematics", 32768, RATE): "at least 10,000,000",
    ("training", 8192, RATE): "at least 250,000",
}
ACTIONS = 10
"""How many steps a turn has; nobody waits for the GPU within one."""

Results = Iterator[tuple[str, float]]


def wait(device: str) -> None:
    """Wait until the GPU has done all its work."""
    import torch

    if device != "cpu":
        torch.cuda.synchronize(device)


def memory(device: str) -> float:
    """The memory in use on a GPU, MB."""
    import torch

    free, total = torch.cuda.mem_get_info(device)
    return (total - free) / 1e6


def steps_of(env: MaraVectorEnv, device: str, actions: int = ACTIONS) -> Callable[[], int]:
    """Steps of the environment with so many random actions in turn, which are tensors on the device."""
    rng = np.random.default_rng(0)
    low, high = env.simulation.action_space.low, env.simulation.action_space.high
    shape = (env.num_envs, len(low))
    asarray = env.simulation.backend.asarray
    drawn = [asarray(rng.uniform(low, high, shape)) for _ in range(actions)]

    def run() -> int:
        for index in range(ACTIONS):
            env.step(drawn[index % actions])
        wait(device)
        return ACTIONS * env.num_envs

    return run


def bare_steps(env: MaraVectorEnv, device: str) -> Callable[[], int]:
    """MuJoCo Warp alone: a graph of the physics steps of one control period, of the same model, from the states of the environment."""
    import mujoco_warp as mjw
    import warp as wp

    from gym_mara.backends.warp.backend import WarpBackend
    from gym_mara.backends.warp.device import capturing
    from gym_mara.backends.warp.model import warp_model

    backend = env.simulation.backend
    assert isinstance(backend, WarpBackend)
    engine = backend._engine
    with wp.ScopedDevice(engine.device):
        model = warp_model(backend.robot, engine._physics_step)
        room = {"njmax": engine.data.njmax, "naconmax": engine.data.naconmax}
        data = mjw.make_data(model, env.num_envs, **room)
        mjw.step(engine.model, data)  # loads the kernels, which a capture must not
        with capturing(engine.device) as capture:
            for _ in range(engine._steps):
                mjw.step(engine.model, data)

    def run() -> int:
        with wp.ScopedDevice(engine.device):
            wp.copy(data.qpos, engine.data.qpos)
            wp.copy(data.qvel, engine.data.qvel)
            for _ in range(ACTIONS):
                wp.capture_launch(capture.graph)
            wp.synchronize_device()
        return ACTIONS * env.num_envs

    return run


def points_of_contact(env: Any) -> float:
    """The points of contact at the end of the last step, of an arm on average."""
    return float(env.simulation.backend._engine.data.nacon.numpy()[0]) / env.num_envs


def make(arms: int, device: str, **options: Any) -> MaraVectorEnv:
    """The arms, with tensors on the device."""
    options |= {"backend": "warp", "arrays": "torch", "device": device}
    return MaraVectorEnv(arms, TASK, autoreset_mode="SameStep", **options)


def start(arms: int, device: str, seconds: float) -> Results:
    """The time until an environment has made its first step."""
    began = time.perf_counter()
    env = make(arms, device)
    env.reset(seed=0)
    env.step(env.simulation.backend.asarray(np.zeros(env.action_space.shape or ())))
    wait(device)
    yield START, time.perf_counter() - began


def dynamics(arms: int, device: str, seconds: float) -> Results:
    """Full dynamics with contacts, compared with MuJoCo Warp alone."""
    wait(device)  # so that the libraries' own memory does not count
    before = 0.0 if device == "cpu" else memory(device)
    env = make(arms, device)
    env.reset(seed=0)
    run = steps_of(env, device)
    run()
    if device != "cpu":
        yield MEMORY, memory(device) - before
    yield CONTACTS, points_of_contact(env)
    alone = rates({RATE: run}, seconds)
    yield RATE, alone[RATE]
    measured = rates({RATE: run, BARE: bare_steps(env, device)}, seconds)
    yield BARE, measured[BARE]
    yield RATIO, measured[RATE] / measured[BARE]


def in_contact(arms: int, device: str, seconds: float) -> Results:
    """The same with arms that stay in contact: each keeps one random target, and is not reset."""
    env = make(arms, device, on_collision="continue")
    env.reset(seed=0)
    run = steps_of(env, device, 1)
    for _ in range(10):  # for two seconds of simulation, until they are there
        run()
    yield CONTACTS, points_of_contact(env)
    yield RATE, rates({RATE: run}, seconds)[RATE]


def kinematics(arms: int, device: str, seconds: float, **options: Any) -> Results:
    """Joints that reach their targets within a step, with collisions."""
    env = make(arms, device, dynamics=False, **options)
    env.reset(seed=0)
    yield RATE, rates({RATE: steps_of(env, device)}, seconds)[RATE]


def travelling(arms: int, device: str, seconds: float) -> Results:
    """Joints with a limited velocity, whose paths are checked for collisions."""
    return kinematics(arms, device, seconds, **TRAVELLING)


def training(arms: int, device: str, seconds: float) -> Results:
    """PPO of RSL-RL, as in examples/rsl_rl_ppo.py, with rollouts and updates."""
    os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")  # RSL-RL imports it, also where git is not
    sys.path.append(str(Path(__file__).parents[1] / "examples"))
    import rsl_rl_ppo

    env = rsl_rl_ppo.make(arms, device)
    rollout = rsl_rl_ppo.ROLLOUT * arms
    runner = rsl_rl_ppo.train(env, rollout)

    def run() -> int:
        runner.learn(1)
        wait(device)
        return rollout

    yield RATE, rates({RATE: run}, seconds)[RATE]


MEASURES: dict[str, Callable[[int, str, float], Results]] = {
    "start": start,
    "dynamics": dynamics,
    "dynamics in contact": in_contact,
    "kinematics": kinematics,
    "travelling": travelling,
    "training": training,
}


def measure(name: str, arms: int, device: str, seconds: float) -> None:
    """Write the results of one measurement to standard output, each as soon as it is known, and all else to standard error."""
    with os.fdopen(os.dup(sys.stdout.fileno()), "w") as results:
        os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
        try:
            for result in MEASURES[name](arms, device, seconds):
                print(json.dumps(result), file=results, flush=True)
        except Exception as error:
            why = " ".join(f"{type(error).__name__}: {error}".split())
            print(json.dumps((FAILED, why)), file=results, flush=True)
            raise


def in_own_process(*arguments: str, timeout: float) -> Iterator[tuple[str, float | str]]:
    """The results of a measurement, and what went wrong, if anything."""
    command, known = [sys.executable, __file__, *arguments], False
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        stopper = threading.Timer(timeout, process.kill)
        stopper.start()
        assert process.stdout is not None
        for line in process.stdout:
            what, value = json.loads(line)
            known = known or what == FAILED
            yield what, value
        code, late = process.wait(), not stopper.is_alive()
        stopper.cancel()
    if code and not known:
        yield FAILED, f"not ready after {timeout:g} s" if late else f"exit code {code}"


def card(device: str) -> str:
    """The name of the GPU, its driver and its memory, as nvidia-smi says; of a CPU its kind."""
    if device == "cpu":
        return f"CPU {platform.processor() or platform.machine()}, {os.cpu_count()} cores"
    query = "--query-gpu=name,driver_version,memory.total"
    try:
        command = ["nvidia-smi", query, "--format=csv,noheader"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        import torch

        return torch.cuda.get_device_name(device)


def versions() -> str:
    """The versions of gym_mara, Python and the libraries."""
    found = [f"gym_mara {gym_mara.__version__}", f"Python {platform.python_version()}"]
    for library in LIBRARIES:
        with contextlib.suppress(PackageNotFoundError):
            found.append(f"{library} {version(library)}")
    return ", ".join(found)


def check(device: str) -> None:
    """Check that the libraries and the GPU are there.

    Raises:
        GymMaraError: they are not.
    """
    with needs("this benchmark", "warp"):
        import torch
        import warp  # noqa: F401
    if device != "cpu" and not torch.cuda.is_available():
        raise GymMaraError(
            f"torch {torch.__version__} finds no GPU of NVIDIA: the driver is missing (nvidia-smi lists GPUs), or torch is a "
            "build for CPUs; --device cpu --arms 8 --training-arms 8 tries this script without one"
        )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--device", default="cuda:0")
    parser.add_argument("--arms", type=int, nargs="+", default=ARMS)
    parser.add_argument("--training-arms", type=int, default=8192)
    parser.add_argument("--seconds", type=float, default=3.0, help="how long a speed is measured")
    parser.add_argument("--timeout", type=float, default=240.0, help="of one measurement, s")
    parser.add_argument("--out", type=Path, help="a file for the same text")
    parser.add_argument("--measure", help=argparse.SUPPRESS)
    options = parser.parse_args()
    try:
        check(options.device)
    except GymMaraError as error:
        sys.exit(str(error))
    if options.measure:
        measure(options.measure, options.arms[0], options.device, options.seconds)
        return
    with contextlib.ExitStack() as stack:
        outputs = [sys.stdout]
        if options.out:
            outputs.append(stack.enter_context(options.out.open("w")))
        os.environ["WARP_CACHE_PATH"] = stack.enter_context(tempfile.TemporaryDirectory())
        for line in report(options):
            for output in outputs:
                print(line, file=output, flush=True)


def report(options: argparse.Namespace) -> Iterator[str]:
    """The lines of the report, each as soon as it is known."""
    yield f"# {card(options.device)}\n\n{versions()}, {date.today()}\n"
    yield f"{TASK}, random actions, tensors on the device; the best of {REPETITIONS} turns in {options.seconds:g} s.\n"
    yield "| measurement | arms | what | value | target |\n|---|---|---|---|---|"
    first = options.arms[0]
    rows = [("start", "start, kernels are compiled", first)]
    rows += [("start", "start, kernels come from the cache", first)]
    rows += [(name, name, arms) for name in AT_EACH for arms in options.arms]
    rows += [(name, name, options.arms[-2:][0]) for name in AT_ONE]
    rows += [("training", "training", options.training_arms)]
    used: dict[int, float] = {}
    for name, label, arms in rows:
        arguments = ["--measure", name, "--arms", str(arms), "--device", options.device]
        arguments += ["--seconds", str(options.seconds)]
        for what, value in in_own_process(*arguments, timeout=options.timeout):
            text = value if isinstance(value, str) else f"{value:,.{0 if value >= 100 else 2}f}"
            target = TARGETS.get((name, arms, what), "")
            yield f"| {label} | {arms:,} | {what} | {text} | {target} |"
            if what == MEMORY and not isinstance(value, str):
                used[arms] = value
    if len(used) > 1:
        (few, less), (many, more) = min(used.items()), max(used.items())
        each = 1000.0 * (more - less) / (many - few)
        yield f"| dynamics | {few:,} to {many:,} | device memory an arm, kB | {each:,.1f} | |"


if __name__ == "__main__":
    main()
