"""Cost of gym_mara in each library: its training loop on MARA-v0, compared with the same loop on an environment that does nothing.

Both are trained in turn for some rounds, and the shortest time of each counts. With the Gymnasium that RLlib pins, in the virtual
environment of `make test-rllib`, only RLlib is measured.

    python benchmarks/libraries.py [NAME ...]
"""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path

import yaml

EXAMPLES = Path(__file__).parents[1] / "examples"
HERE = str(Path(__file__).parent)
OURS, IDLE = "gym_mara:gym_mara/MARA-v0", "idle:idle/MARA-v0"
ROUNDS = 3
OF_RLLIB = "1.2."
"""The versions of Gymnasium that RLlib works with."""

Job = Callable[[], object]


def through_example(script: str, steps: int, way: str = "make") -> Callable[[str], Job]:
    """Train as an example does."""

    def of(env_id: str) -> Job:
        module = importlib.import_module(script)
        return partial(module.train, getattr(module, way)(env_id), steps)

    return of


def through_batch(script: str, steps: int, way: str = "make") -> Callable[[str], Job]:
    """Train as an example with our VecEnv does."""

    def of(env_id: str) -> Job:
        from idle_vec_env import IdleVecEnv

        module = importlib.import_module(script)
        arms = getattr(module, way)()
        return partial(module.train, arms if env_id == OURS else IdleVecEnv(arms), steps)

    return of


def through_zoo(algo: str, steps: int) -> Callable[[str], Job]:
    """Train as RL Baselines3 Zoo does, with the configuration in examples/rl_zoo3."""

    def of(env_id: str) -> Job:
        zoo = importlib.import_module("zoo")
        folder = Path(tempfile.mkdtemp())
        config = yaml.safe_load((EXAMPLES / "rl_zoo3" / f"{algo}.yml").read_text())
        config["idle/MARA-v0"] = config["gym_mara/MARA-v0"] | {"vec_env_wrapper": None}
        (folder / "config.yml").write_text(yaml.safe_dump(config))
        options = ["--algo", algo, "--env", env_id.partition(":")[2], "-n", str(steps)]
        options += ["--conf-file", str(folder / "config.yml"), "-f", str(folder)]
        options += ["--eval-freq", "-1", "--verbose", "0", "--seed", "0"]

        def job() -> None:
            sys.argv = ["zoo", *options]
            zoo.train()

        return job

    return of


def through_rllib(steps: int) -> Callable[[str], Job]:
    """Train as examples/rllib_ppo.py does, with two remote env runners."""

    def of(env_id: str) -> Job:
        module = importlib.import_module("rllib_ppo")
        return partial(module.train, module.config(env_id), steps)

    return of


LIBRARIES: dict[str, tuple[str, Callable[[str], Job]]] = {
    "Stable-Baselines3, one": ("stable_baselines3", through_example("sb3_ppo", 4096, "single")),
    "Stable-Baselines3, in turn": (
        "stable_baselines3",
        through_example("sb3_ppo", 4096, "in_turn"),
    ),
    "Stable-Baselines3, SubprocVecEnv": (
        "stable_baselines3",
        through_example("sb3_ppo", 4096, "in_processes"),
    ),
    "Stable-Baselines3, native": ("stable_baselines3", through_batch("sb3_ppo", 65536, "native")),
    "rl_zoo3, PPO": ("rl_zoo3", through_zoo("ppo", 65536)),
    "rl_zoo3, ACKTR": ("rl_zoo3", through_zoo("acktr", 65536)),
    "CleanRL's style": ("torch", through_example("cleanrl_ppo", 16384)),
    "TorchRL": ("torchrl", through_example("torchrl_ppo", 16384)),
    "skrl": ("skrl", through_example("skrl_ppo", 65536)),
    "Tianshou": ("tianshou", through_example("tianshou_ppo", 65536)),
    "sbx": ("sbx-rl", through_batch("sbx_ppo", 65536)),
}
RLLIB = {"RLlib": ("ray", through_rllib(100_000))}


def seconds(job: Job) -> float:
    """The duration of a job, s; its output is not shown."""
    with contextlib.redirect_stdout(io.StringIO()):
        start = time.perf_counter()
        job()
        return time.perf_counter() - start


def main() -> None:
    """Measure and print."""
    sys.path[:0] = [str(EXAMPLES), str(EXAMPLES / "rl_zoo3"), HERE]
    os.environ["PYTHONPATH"] = os.pathsep.join([HERE, os.environ.get("PYTHONPATH", "")])
    import idle  # noqa: F401 - registers
    import torch

    torch.set_num_threads(1)
    known = RLLIB if version("gymnasium").startswith(OF_RLLIB) else LIBRARIES
    print("| library | version | MARA-v0, s | does nothing, s | ratio |")
    print("|---|---|---|---|---|")
    for name in sys.argv[1:] or known:
        package, of = known[name]
        best = {OURS: float("inf"), IDLE: float("inf")}
        for number in range(ROUNDS + 1):
            for env_id in best:
                spent = seconds(of(env_id))
                if number:  # the first round only warms up
                    best[env_id] = min(best[env_id], spent)
        ratio = best[OURS] / best[IDLE]
        cells = name, version(package), f"{best[OURS]:.2f}", f"{best[IDLE]:.2f}", f"{ratio:.2f}"
        print("|", " | ".join(cells), "|", flush=True)


if __name__ == "__main__":
    main()
