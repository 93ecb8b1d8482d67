"""Evaluates a policy over whole episodes: position error, angle, rewards and collisions."""

from __future__ import annotations

from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecNormalize

from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.runs.policy import load_policy
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.backends import backend_settings
from gym_mara.envs import MaraVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.tasks import MAX_EPISODE_STEPS
from gym_mara.types import Floats

METRICS = ("position_error_mm", "angle_deg", "reward_per_step", "return", "collisions")


def make_env(
    task: str,
    backend: str,
    num_envs: int,
    options: dict[str, Any],
    max_episode_steps: int | None = MAX_EPISODE_STEPS,
) -> MaraVecEnv:
    """N arms of a task for Stable-Baselines3."""
    env = MaraVectorEnv(
        num_envs,
        task,
        backend=backend,
        autoreset_mode="SameStep",
        max_episode_steps=max_episode_steps,
        **options,
    )
    return MaraVecEnv(env)


def evaluate_run(
    run: RunFolder,
    *,
    backend: str | None = None,
    episodes: int = 10,
    which: str = "last",
    options: dict[str, Any] | None = None,
) -> dict[str, Floats]:
    """Play episodes with a run's deterministic policy.

    Args:
        run: the run.
        backend: the backend to play on; by default the one that the run was trained on.
        episodes: the number of episodes.
        which: the policy, "last" or "best".
        options: keyword arguments of the environment, in addition to those of the run.

    Returns:
        Each of METRICS per episode (episodes,); position error and angle are those of the last step.

    Raises:
        GymMaraError: the policy is missing, damaged, or of another environment; episodes is below 1.
    """
    if episodes < 1:
        raise GymMaraError(f"episodes must be at least 1, not {episodes}")
    config = run.config
    backend = backend or config.backend
    settings = {**options_on(backend, config), **(options or {})}
    env = make_env(config.env, backend, episodes, settings)
    try:
        policy, wrapped = load_policy(run.policy(which), config, env)
        env.seed(config.seed)
        return play(policy, wrapped)
    finally:
        env.close()


def options_on(backend: str, config: RunConfig) -> dict[str, Any]:
    """The keyword arguments of a run's environment; on another backend without the settings of the run's own."""
    return config.env_options if backend == config.backend else options_beyond_backend(config)


def options_beyond_backend(config: RunConfig) -> dict[str, Any]:
    """The keyword arguments of a run's environment, without the settings of its backend."""
    own = backend_settings(config.backend)
    return {name: value for name, value in config.env_options.items() if name not in own}


def play(policy: PolicyPredictor, env: VecNormalize) -> dict[str, Floats]:
    """Play one episode per arm with the deterministic policy; returns METRICS, each (N,)."""
    results: list[dict[str, Any] | None] = [None] * env.num_envs
    observation: Any = env.reset()
    while any(result is None for result in results):
        action, _ = policy.predict(observation, deterministic=True)
        observation, _, done, infos = env.step(action)
        for index in np.flatnonzero(done):
            results[index] = results[index] or infos[index]
    finished = [result for result in results if result is not None]
    columns = (
        [1000.0 * r.get("position_error", np.nan) for r in finished],
        [np.degrees(r.get("angle_error", np.nan)) for r in finished],
        [r["ep_rew_mean"] for r in finished],
        [r["episode"]["r"] for r in finished],
        [r["num_coll"] for r in finished],
    )
    return {name: np.array(column, float) for name, column in zip(METRICS, columns, strict=True)}


def spread(metrics: dict[str, Floats]) -> dict[str, dict[str, float]]:
    """Mean, standard deviation, minimum and maximum of each metric over the episodes."""
    return {
        name: {
            "mean": float(values.mean()),
            "std": float(values.std()),
            "min": float(values.min()),
            "max": float(values.max()),
        }
        for name, values in metrics.items()
    }
