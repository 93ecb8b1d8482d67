"""How near trained policies bring the tool: 1M steps of PPO, three seeds, the last policy; prints Markdown."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from gym_mara.agents.evaluate import evaluate_run
from gym_mara.agents.run import RunConfig
from gym_mara.agents.train import train
from gym_mara.tasks import TASKS


def main() -> None:
    """Train, evaluate and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--envs", nargs="+", default=list(TASKS), choices=list(TASKS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--steps", type=float, default=1e6)
    arguments = parser.parse_args()
    print("| environment | seed | position error, mm | angle, deg | reward per step | time, s |")
    print("|---|---|---|---|---|---|")
    for env in arguments.envs:
        results = []
        for seed in arguments.seeds:
            start = time.perf_counter()
            config = RunConfig(env, "ppo", "pinocchio", int(arguments.steps), seed)
            with TemporaryDirectory() as folder:
                run = train(config, Path(folder) / "run", lambda steps, shown: None)
                metrics = evaluate_run(run, episodes=1)
            names = ("position_error_mm", "angle_deg", "reward_per_step")
            results.append([float(metrics[name].mean()) for name in names])
            values = " | ".join(f"{value:.2f}" for value in results[-1])
            print(f"| {env} | {seed} | {values} | {time.perf_counter() - start:.0f} |", flush=True)
        medians = " | ".join(f"{median(column):.2f}" for column in zip(*results, strict=True))
        print(f"| {env} | **median** | {medians} | |", flush=True)


if __name__ == "__main__":
    main()
