"""Trains an agent into a run folder, or resumes an interrupted run."""

from __future__ import annotations

import errno
import inspect
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Dict, Space
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from gym_mara.agents.algorithms.base import Preset, is_schedule, policy_class
from gym_mara.agents.algorithms.off_policy import WarmUp
from gym_mara.agents.algorithms.registry import (
    DEFAULT_ALGORITHM,
    DEFAULT_PRESET,
    algorithm,
)
from gym_mara.agents.runs.config import check_backend
from gym_mara.agents.runs.evaluation import make_env
from gym_mara.agents.runs.folder import DamagedRunError, RunConfig, RunFolder
from gym_mara.agents.runs.policy import base_env, policy_arguments
from gym_mara.agents.training import DEFAULT_LOGGERS
from gym_mara.agents.training.callbacks import CheckpointCallback, OnProgress
from gym_mara.agents.training.checkpoint import Progress, restore_state
from gym_mara.agents.training.loggers import check_loggers, make_writers
from gym_mara.agents.training.replay import hindsight
from gym_mara.agents.training.warm_start import begin_with
from gym_mara.errors import GymMaraError, TrainingDivergedError
from gym_mara.files import DamagedFileError, locked, refuse_links
from gym_mara.registration import own_backend


def train(
    config: RunConfig,
    out: Path,
    on_progress: OnProgress,
    *,
    preset: Preset | None = None,
    log: Sequence[str] = DEFAULT_LOGGERS,
) -> RunFolder:
    """Train an agent into a new run folder.

    Args:
        config: what to train.
        out: the folder.
        on_progress: called after every rollout.
        preset: hyperparameters to use instead of the preset that the configuration names.
        log: the loggers, from `gym_mara.agents.training.LOGGERS`; the table of the run is always written.

    Raises:
        GymMaraError: a name is unknown, a value is out of range, or the folder exists.
        MissingExtraError: the library of a logger is not installed.
        TrainingDivergedError: the agent's parameters are no longer finite.
    """
    check_loggers(log)
    algorithm(config.algo)  # an unknown name is an error before anything is built
    check_backend(config.backend)
    config = replace(config, preset=asdict(preset or preset_of(config)))
    model = new_model(config)  # if this fails, no folder is made
    if config.start is not None:
        try:
            begin_with(model, config)
        except BaseException:
            base_env(model).close()
            raise
    run = RunFolder.create(out, config)
    with _locked(run):
        return _learn(run, model, on_progress, log)


def preset_of(config: RunConfig) -> Preset:
    """The preset that a configuration names, for the task, the backend and the actions of its environment.

    The one for joints that teleport is chosen only if they do so and an action is a joint target. With another action the next
    state depends on the state before, too, and joints seem to travel.

    Raises:
        GymMaraError: the algorithm, the preset, or a part of the environment is unknown.
    """
    presets = algorithm(config.algo).presets_of(config.preset_name)
    env = make_env(config.env, config.backend, 1, config.env_options)
    try:
        simulation = env.env.simulation
        teleports = simulation.backend.teleports and simulation.actions.mode == "absolute"
        return presets.choose(teleports=teleports, family=simulation.task.preset_family)
    finally:
        env.close()


def resume(
    path: Path, on_progress: OnProgress, *, log: Sequence[str] = DEFAULT_LOGGERS
) -> RunFolder:
    """Resume a run from its last checkpoint. The result is the same as without the interruption.

    Args:
        path: the run folder.
        on_progress, log: as in `train`.

    Raises:
        MissingExtraError: the library of a logger is not installed.
        GymMaraError: the folder holds no run, the run is damaged or has finished, another process trains it, or a symbolic
            link is in it.
        TrainingDivergedError: the agent's parameters are no longer finite.
    """
    check_loggers(log)
    run = RunFolder.open(path)
    try:
        refuse_links(path)
    except DamagedFileError as error:
        raise DamagedRunError(str(error)) from None
    with _locked(run):
        return _resume(run, on_progress, log)


def _resume(run: RunFolder, on_progress: OnProgress, log: Sequence[str]) -> RunFolder:
    config, checkpoints = run.config, run.checkpoints()
    if checkpoints and run.trained_steps() >= config.steps and run.has_policy("last"):
        raise GymMaraError(
            f"the run {str(run.path)!r} has finished its {config.steps} steps; start a new run to train longer"
        )
    if config.start is not None and not checkpoints:
        raise DamagedRunError(
            f"the run {str(run.path)!r} ended before it had stored the policy with which it starts: start a new run with "
            f"--from {config.start.run}"
        )
    model = new_model(config)
    try:
        reached = restore_state(model, checkpoints[-1]) if checkpoints else _NOTHING
        if model.num_timesteps != run.trained_steps():
            raise DamagedRunError(
                f"the checkpoint {str(checkpoints[-1])!r} is of step {model.num_timesteps}: give it its own name"
            )
    except BaseException:
        base_env(model).close()
        raise
    return _learn(run, model, on_progress, log, reached)


def _locked(run: RunFolder) -> AbstractContextManager[None]:
    """Lock a run for this process."""
    busy = f"another process is training {str(run.path)!r}; wait for it"
    return locked(run.path / ".lock", busy)


def new_model(config: RunConfig) -> BaseAlgorithm:
    """An untrained agent and its environment, from a configuration."""
    preset = config.made_preset()
    env = make_env(config.env, config.backend, preset.num_envs, config.env_options)
    try:
        model = new_agent(config.algo, preset, env, config.seed)
    except BaseException:
        env.close()
        raise
    if isinstance(model, WarmUp):
        model.policy_is_trained = config.start is not None
    return model


def preset_agent(
    task: str = "MARA-v0",
    algo: str = DEFAULT_ALGORITHM,
    *,
    preset: str = DEFAULT_PRESET,
    backend: str | None = None,
    seed: int = 0,
    **options: Any,
) -> BaseAlgorithm:
    """An untrained agent with the hyperparameters of a preset and its environment, for a script of your own.

    Args:
        task: the name of a task.
        algo: the name of an algorithm.
        preset: the name of a preset.
        backend: the name of a backend; by default that of the environment.
        seed: of the policy, the sampling and the environment.
        **options: keyword arguments of the environment.

    Returns:
        A model of Stable-Baselines3, such as PPO. Schedules of the preset end with the steps given to its first `learn`.

    Raises:
        GymMaraError: a name is unknown, or a value is out of its range.
    """
    config = RunConfig(
        env=task,
        algo=algo,
        backend=backend or own_backend(task),
        steps=1,  # not used: the caller calls `learn`
        seed=seed,
        env_options=options,
        preset_name=preset,
    )
    check_backend(config.backend)
    return new_model(replace(config, preset=asdict(preset_of(config))))


def new_agent(algo: str, preset: Preset, env: VecEnv, seed: int) -> BaseAlgorithm:
    """An untrained agent of an algorithm with a preset, on any vector environment of Stable-Baselines3.

    An off-policy algorithm gets hindsight replay where `hindsight` says so.

    Raises:
        GymMaraError: the algorithm does not take an argument of the preset, or the preset normalises dictionaries.
    """
    if preset.normalise_observation and isinstance(env.observation_space, Dict):
        raise GymMaraError(
            "a preset with normalise_observation needs observations that are arrays, not dictionaries"
        )
    if any(len(space.shape or ()) == 3 for space in _boxes(env.observation_space)):
        raise GymMaraError(
            "the presets are made for states, not for pictures: leave out observation, or train with Stable-Baselines3 itself, as "
            "examples/reach_from_pixels.py does"
        )
    use_one_thread()
    # Rewards are scaled by the returns with the discount factor with which the algorithm learns.
    default = inspect.signature(algorithm(algo).load_class()).parameters["gamma"].default
    wrapped = VecNormalize(
        env,
        norm_obs=preset.normalise_observation,
        norm_reward=preset.normalise_reward,
        gamma=preset.arguments.get("gamma", default),
    )
    arguments = {name: _schedule(value) for name, value in preset.arguments.items()}
    arguments["policy_kwargs"] = policy_arguments(preset, env.observation_space)
    policy = policy_class(preset.policy)
    make = algorithm(algo).load_class()
    if issubclass(make, OffPolicyAlgorithm):
        arguments |= hindsight(env, preset)
    try:
        return make(policy, wrapped, seed=seed, device="cpu", **arguments)
    except (TypeError, ValueError, AssertionError) as error:
        if isinstance(error, GymMaraError):
            raise
        raise GymMaraError(f"{algo} does not take the preset's arguments: {error}") from error


def _boxes(space: Space[Any]) -> list[Space[Any]]:
    """The spaces in a dictionary of spaces, or the space itself."""
    return list(space.values()) if isinstance(space, Dict) else [space]


def use_one_thread() -> None:
    """Limit torch to one thread: for such small networks more threads are slower, and they change the last bits of results."""
    torch.set_num_threads(1)


class PiecewiseLinear:
    """A value that changes linearly between points (progress from 0 to 1, value); a class, because a model on disk needs one."""

    def __init__(self, points: Sequence[Sequence[float]]) -> None:
        self._progress, self._values = zip(*points, strict=True)

    def __call__(self, progress_remaining: float) -> float:
        """The value at the remaining progress, which Stable-Baselines3 counts from 1 down to 0."""
        return float(np.interp(1.0 - progress_remaining, self._progress, self._values))


def _schedule(value: Any) -> Any:
    """A preset's value in the form that the algorithm takes."""
    return PiecewiseLinear(value) if is_schedule(value) else value


_NOTHING = Progress(best=-np.inf, elapsed=0.0)
# The errors of a file that cannot be written; others come from elsewhere, such as the pipe of a worker.
_UNWRITABLE = {
    getattr(errno, name, None)
    for name in (
        "EACCES",
        "EDQUOT",
        "EFBIG",
        "EIO",
        "EISDIR",
        "ENOSPC",
        "ENOTDIR",
        "EPERM",
        "EROFS",
    )
}


def _learn(
    run: RunFolder,
    model: BaseAlgorithm,
    on_progress: OnProgress,
    log: Sequence[str],
    reached: Progress = _NOTHING,
) -> RunFolder:
    callback = CheckpointCallback(run, reached, on_progress)
    try:
        model.set_logger(Logger(str(run.path), make_writers(run, model.num_timesteps, log)))
        try:
            on_progress(model.num_timesteps, {})
            left = run.config.steps - model.num_timesteps
            # No interval: the callback writes the rows.
            model.learn(left, callback, log_interval=None, reset_num_timesteps=False)  # type: ignore[arg-type]
        finally:
            model.logger.close()
    except OSError as error:
        if isinstance(error, GymMaraError) or error.errno not in _UNWRITABLE:
            raise
        raise GymMaraError(
            f"cannot write to {str(error.filename or run.path)!r}: {error.strerror}. "
            f"What is trained is kept up to the last checkpoint: --resume {run.path}"
        ) from error
    except TrainingDivergedError:
        raise
    except (ValueError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
        if isinstance(error, ValueError) and _is_finite(model):
            raise
        raise TrainingDivergedError(
            f"the training diverged: its parameters are no longer finite ({error}); "
            "try a smaller learning rate or trust region"
        ) from error
    finally:  # also after an interrupt
        callback.close()
        base_env(model).close()
    return run


def _is_finite(model: BaseAlgorithm) -> bool:
    """Whether a model's parameters, its standard deviations and their inverses are finite."""
    numbers: list[torch.Tensor] = list(model.policy.parameters())
    if isinstance(log_std := getattr(model.policy, "log_std", None), torch.Tensor):
        numbers += [log_std.exp(), (-log_std).exp()]
    return all(bool(each.isfinite().all()) for each in numbers)
