"""Evaluates a policy over whole episodes: position error, angle, rewards and collisions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv

from gym_mara.agents.runs.config import check_options
from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.runs.policy import load_policy
from gym_mara.agents.sb3 import MaraVecEnv, require_numpy
from gym_mara.agents.scaling import unit_box
from gym_mara.backends import backend_settings
from gym_mara.envs import MaraVectorEnv, make_vector_env
from gym_mara.errors import GymMaraError
from gym_mara.robot import RobotModel
from gym_mara.robot.options import ROBOT_KEYWORDS
from gym_mara.types import Floats

METRICS = ("position_error_mm", "angle_deg", "reward_per_step", "return", "collisions")

MOST_EPISODES = 100_000
_OTHER_ROBOT = {*ROBOT_KEYWORDS} - {"package_dirs"}
"""The keyword arguments that make another robot; `package_dirs` only says where its files are."""
RANDOM_EPISODES = 5
"""How many episodes judge a policy where they are random: as many as in Stable-Baselines3's `EvalCallback`."""


def make_arms(
    env: str, backend: str, num_envs: int, options: dict[str, Any], **limit: int | None
) -> MaraVectorEnv:
    """N arms of an environment, in at most `workers` processes, a divisor of N; `limit` may be `max_episode_steps`."""
    workers = options.get("workers")
    if type(workers) is int and workers > 0:
        options = {**options, "workers": math.gcd(workers, num_envs)}
    arms = make_vector_env(
        env, num_envs, backend=backend, autoreset_mode="SameStep", **limit, **options
    )
    require_numpy(arms)
    return arms


def make_env(
    env: str, backend: str, num_envs: int, options: dict[str, Any], **limit: int | None
) -> MaraVecEnv:
    """N arms of an environment for the agents of the presets, with actions in [-1, 1]."""
    arms = make_arms(env, backend, num_envs, options, **limit)
    return MaraVecEnv(arms, unit_box(len(arms.simulation.action_space.low)))


def episodes_to_judge(config: RunConfig) -> int:
    """How many episodes judge a policy of this run: one where all are the same, else RANDOM_EPISODES."""
    env = make_arms(config.env, config.backend, 1, config.env_options)
    try:
        return RANDOM_EPISODES if env.simulation.random else 1
    finally:
        env.close()


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
        GymMaraError: the policy is missing, damaged, or of another environment or robot; episodes is out of its range; or
            an option is unknown.
    """
    if not 1 <= episodes <= MOST_EPISODES:
        raise GymMaraError(
            f"episodes must be at least 1 and at most {MOST_EPISODES}, not {episodes}"
        )
    config = run.config
    policy = load_policy(run, which)
    backend = backend or config.backend
    settings = policy.about.keywords(backend, options_on(backend, config, options))
    env = MaraVecEnv(make_arms(config.env, backend, episodes, settings))
    try:
        policy.check(env.env.simulation, any_robot=chose_robot(settings))
        env.seed(config.seed)
        return play(policy, env)
    finally:
        env.close()


def options_on(
    backend: str, config: RunConfig, options: dict[str, Any] | None = None
) -> dict[str, Any]:
    """The keyword arguments of a run's environment; on another backend without the settings of the run's own.

    Args:
        backend: the name of the backend.
        config: the configuration of the run.
        options: keyword arguments that replace those of the run. With one that changes the robot, it is loaded here, and the
            policy may play on a robot that differs from that of the training.

    Raises:
        GymMaraError: a name cannot be an option of a run, or the robot cannot be loaded.
    """
    own = config.env_options if backend == config.backend else options_beyond_backend(config)
    return with_options(own, options or {})


def with_options(own: dict[str, Any], given: dict[str, Any]) -> dict[str, Any]:
    """The keyword arguments of a run's environment, some of them replaced as in `options_on`."""
    check_options(given, pictures=True)
    if isinstance(given.get("robot"), RobotModel):  # nothing of the run's robot is left
        own = {name: value for name, value in own.items() if name not in ROBOT_KEYWORDS}
    merged = {**own, **given}
    if given.keys() & _OTHER_ROBOT:
        of_robot = {name: merged.pop(name) for name in ROBOT_KEYWORDS if name in merged}
        merged["robot"] = RobotModel.load(of_robot.pop("robot", "mara"), **of_robot)
    return merged


def chose_robot(options: dict[str, Any]) -> bool:
    """Whether these options, of `options_on`, have a robot that was given in addition to those of the run."""
    return isinstance(options.get("robot"), RobotModel)


def options_beyond_backend(config: RunConfig) -> dict[str, Any]:
    """The keyword arguments of a run's environment, without the settings of its backend."""
    own = backend_settings(config.backend)
    return {name: value for name, value in config.env_options.items() if name not in own}


def play(policy: PolicyPredictor, env: VecEnv) -> dict[str, Floats]:
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


def spread(metrics: dict[str, Floats]) -> dict[str, dict[str, float] | None]:
    """Mean, standard deviation, minimum and maximum of each metric over the episodes that have a value; None if none has."""
    return {name: _spread(values[~np.isnan(values)]) for name, values in metrics.items()}


def _spread(values: Floats) -> dict[str, float] | None:
    if not len(values):
        return None
    return {
        "mean": float(values.mean()),
        "std": float(values.std()),
        "min": float(values.min()),
        "max": float(values.max()),
    }
