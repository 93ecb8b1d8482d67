"""Time of a training, compared with an environment that does nothing, and time of one update of each algorithm."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from idle_vec_env import IdleVecEnv
from stable_baselines3.common.base_class import BaseAlgorithm

from gym_mara.agents.algorithms.registry import ALGORITHMS, algorithm
from gym_mara.agents.runs.evaluation import make_env
from gym_mara.agents.training.train import new_agent

STEPS = 1_000_000
DYNAMIC_STEPS = 300_000
SLICES = 5


def training_ratio(name: str, task: str = "MARACollisionOrient-v0") -> str:
    """Train PPO for 1M steps on both, slice by slice in turn, with the preset of this name; compare the times."""
    preset = algorithm("ppo").preset(name, teleports=True)
    ours = make_env(task, "pinocchio", preset.num_envs, {})
    models = [new_agent("ppo", preset, env, seed=0) for env in (ours, IdleVecEnv(ours))]
    seconds = [0.0, 0.0]
    for _ in range(SLICES):
        for index, model in enumerate(models):
            seconds[index] += _learn(model, STEPS // SLICES)
    return (
        f"- {task}, preset {name}, {STEPS:,} steps: {seconds[0]:.1f} s; doing nothing: {seconds[1]:.1f} s; "
        f"ratio {seconds[0] / seconds[1]:.2f}"
    )


def _learn(model: BaseAlgorithm, steps: int) -> float:
    start = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    return time.perf_counter() - start


def print_dynamic_training() -> None:
    """Train PPO from scratch on both dynamic backends, slice by slice in turn, as `gym-mara train` does, and print the times."""
    print(f"\n## Training with PPO on dynamics, MARA-v0, {DYNAMIC_STEPS:,} steps from scratch\n")
    preset = algorithm("ppo").preset("tuned", teleports=False)
    ways: dict[str, dict[str, Any]] = {
        "mujoco": {},
        "dart": {},
        "dart, one process": {"workers": 1},
    }
    models = {}
    for name, options in ways.items():
        env = make_env("MARA-v0", name.partition(",")[0], preset.num_envs, options)
        models[name] = new_agent("ppo", preset, env, seed=0)
    seconds = dict.fromkeys(models, 0.0)
    for _ in range(SLICES):
        for name, model in models.items():
            seconds[name] += _learn(model, DYNAMIC_STEPS // SLICES)
    learner = _learn(new_agent("ppo", preset, IdleVecEnv(env), seed=0), DYNAMIC_STEPS)
    print("| backend | s | mujoco's time, relative to it | target |")
    print("|---|---|---|---|")
    for name, spent in (seconds | {"none: arms that do nothing": learner}).items():
        target = "at most 0.4" if name == "dart" else ""
        print(f"| {name} | {spent:.1f} | {seconds['mujoco'] / spent:.2f} | {target} |", flush=True)


def update_costs(batch: int = 2048) -> dict[str, float]:
    """The time of an update of each on-policy algorithm on a batch of the same size, ms: the shortest of several turns."""
    models: dict[str, Any] = {}
    for algo in ALGORITHMS:
        preset = algorithm(algo).preset("tuned", teleports=True)
        if "n_steps" not in preset.arguments:
            continue  # an off-policy algorithm learns from its replay buffer, not from a batch of steps
        steps = batch // preset.num_envs
        preset = replace(preset, arguments={**preset.arguments, "n_steps": steps})
        env = make_env("MARACollisionOrient-v0", "pinocchio", preset.num_envs, {})
        models[algo] = new_agent(algo, preset, env, seed=0)
        models[algo].learn(batch)
    spent: dict[str, list[float]] = {algo: [] for algo in models}
    for _ in range(10):
        for algo, model in models.items():
            start = time.perf_counter()
            model.train()
            spent[algo].append(1000.0 * (time.perf_counter() - start))
    return {algo: min(times) for algo, times in spent.items()}


def print_training() -> None:
    """Measure and print."""
    print("\n## Training with PPO, compared with an environment that does nothing\n")
    for name in ("tuned", "paper"):
        print(training_ratio(name))
    print("\n## One update on the same batch of 2048 steps, tuned presets\n")
    costs = update_costs()
    print("| algorithm | ms | relative to PPO |")
    print("|---|---|---|")
    for algo, cost in costs.items():
        print(f"| {algo} | {cost:.1f} | {cost / costs['ppo']:.2f} |")


if __name__ == "__main__":
    print_training()
