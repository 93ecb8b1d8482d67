"""Training an agent: from a configuration to a finished run folder, or on from where a run was cut off."""

from __future__ import annotations

import os
import pickle
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock, Timeout
from stable_baselines3.common.logger import (
    CSVOutputFormat,
    KVWriter,
    Logger,
    TensorBoardOutputFormat,
)
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize
from torch.utils.tensorboard import SummaryWriter

from gym_mara.agents.algorithms.base import Preset, is_schedule, policy_class
from gym_mara.agents.algorithms.registry import algorithm
from gym_mara.agents.runs.evaluation import make_env
from gym_mara.agents.runs.folder import DamagedRunError, RunConfig, RunFolder, read_progress
from gym_mara.agents.runs.policy import load_model, policy_arguments
from gym_mara.agents.training.callbacks import (
    Keeper,
    Report,
    base_env,
    restore_random_state,
)
from gym_mara.errors import GymMaraError, TrainingDivergedError


def train(
    config: RunConfig, out: Path, report: Report, *, preset: Preset | None = None
) -> RunFolder:
    """Train an agent into a new run folder.

    Args:
        config: what to train.
        out: the folder.
        report: called after every update.
        preset: hyperparameters in place of the preset that the configuration names.

    Raises:
        GymMaraError: a name is unknown, a value out of range, or the folder exists.
        TrainingDivergedError: the agent's numbers are no longer finite.
    """
    for name in ("steps", "checkpoint_every"):
        if getattr(config, name) < 1:
            raise GymMaraError(f"{name} must be at least 1, not {getattr(config, name)}")
    if not 0 <= config.seed < 2**32:
        raise GymMaraError(f"seed must be a whole number from 0 to 2**32 - 1, not {config.seed}")
    algorithm(config.algo)  # an unknown name is an error before anything is built
    preset = preset or preset_of(config)
    config = RunConfig(**{**asdict(config), "preset": asdict(preset)})
    model = new_model(config)  # before the folder: what cannot be built leaves none behind
    run = RunFolder.create(out, config)
    with _alone(run):
        return _learn(run, model, report=report)


def preset_of(config: RunConfig) -> Preset:
    """The preset that a configuration names, for joints that teleport or travel as in its environment.

    Raises:
        GymMaraError: the algorithm, the preset, or a part of the environment is unknown.
    """
    pair = algorithm(config.algo).preset_pair(config.preset_name)
    env = make_env(config.env, config.backend, 1, config.env_options)
    try:
        teleports = env.env.simulation.backend.teleports
    finally:
        env.close()
    return pair.teleporting if teleports else pair.travelling


def resume(path: Path, report: Report) -> RunFolder:
    """Go on with a run from its last checkpoint, as if it had never been cut off.

    Raises:
        GymMaraError: it is no run folder, it is damaged, it has finished, or another process trains it.
        TrainingDivergedError: the agent's numbers are no longer finite.
    """
    run = RunFolder.open(path)
    with _alone(run):
        return _go_on(run, report)


def _go_on(run: RunFolder, report: Report) -> RunFolder:
    config = run.config
    checkpoints = run.checkpoints()
    if not checkpoints:
        return _learn(run, new_model(config), report=report)
    use_one_thread()
    preset = Preset(**config.preset)
    env = make_env(config.env, config.backend, preset.num_envs, config.env_options)
    model, wrapped = load_model(checkpoints[-1], config.algo, env)
    if model.num_timesteps >= config.steps and run.has_policy("last"):
        raise GymMaraError(
            f"the run {str(run.path)!r} has finished its {config.steps} steps; for more begin a new one"
        )
    try:
        state = pickle.loads((checkpoints[-1] / "state.pkl").read_bytes())
        env.restore_state(state["env"])
        wrapped.returns = state["returns"]
        restore_random_state(state["random"])
        best, elapsed = float(state["best"]), float(state["elapsed"])
    except Exception as error:  # a damaged pickle raises anything
        raise DamagedRunError(
            f"the checkpoint {str(checkpoints[-1])!r} is damaged ({error}); delete it to go on from the one before"
        ) from error
    return _learn(run, model, report=report, best=best, elapsed=elapsed)


@contextmanager
def _alone(run: RunFolder) -> Iterator[None]:
    """Keep a run to this process; the system frees it when the process is killed.

    Raises:
        GymMaraError: another process trains it.
    """
    lock = FileLock(run.path / ".lock", timeout=0)
    try:
        lock.acquire()
    except Timeout:
        raise GymMaraError(f"another process is training {str(run.path)!r}; wait for it") from None
    try:
        yield
    finally:
        lock.release()


def new_model(config: RunConfig) -> OnPolicyAlgorithm:
    """An untrained agent, with its environment, as a configuration asks for it."""
    preset = Preset(**config.preset)
    env = make_env(config.env, config.backend, preset.num_envs, config.env_options)
    return new_agent(config.algo, preset, env, config.seed)


def new_agent(algo: str, preset: Preset, env: VecEnv, seed: int) -> OnPolicyAlgorithm:
    """An untrained agent of an algorithm and a preset on any environment of Stable-Baselines3."""
    use_one_thread()
    wrapped = VecNormalize(
        env, norm_obs=preset.normalise_observation, norm_reward=preset.normalise_reward
    )
    arguments = {name: _schedule(value) for name, value in preset.arguments.items()}
    arguments["policy_kwargs"] = policy_arguments(preset)
    policy = policy_class(preset.policy)
    return algorithm(algo).load_class()(policy, wrapped, seed=seed, device="cpu", **arguments)


def use_one_thread() -> None:
    """Keep torch to one thread: for networks this small more cost time, and change the last bits of the result."""
    torch.set_num_threads(1)


class PiecewiseLinear:
    """A value that changes linearly between points, (progress from 0 to 1, value); a class, as a model on disk needs it."""

    def __init__(self, points: Sequence[Sequence[float]]) -> None:
        self._progress, self._values = zip(*points, strict=True)

    def __call__(self, progress_remaining: float) -> float:
        """The value at a progress as Stable-Baselines3 counts it, from 1 down to 0; its last beyond that."""
        return float(np.interp(1.0 - progress_remaining, self._progress, self._values))


def _schedule(value: Any) -> Any:
    """A preset's value in the form that the algorithm takes."""
    return PiecewiseLinear(value) if is_schedule(value) else value


def _learn(
    run: RunFolder,
    model: OnPolicyAlgorithm,
    *,
    report: Report,
    best: float = -np.inf,
    elapsed: float = 0.0,
) -> RunFolder:
    keeper = Keeper(run, best, elapsed, report)
    try:
        model.set_logger(Logger(str(run.path), _writers(run, model.num_timesteps)))
        try:
            report(model.num_timesteps, {})
            left = run.config.steps - model.num_timesteps
            model.learn(left, callback=keeper, reset_num_timesteps=False)
        finally:
            model.logger.close()
    except TrainingDivergedError:
        raise
    except (ValueError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
        if isinstance(error, ValueError) and _is_finite(model):
            raise
        raise TrainingDivergedError(
            f"the training diverged: its numbers are no longer finite ({error}); "
            "try a smaller learning rate or trust region"
        ) from error
    finally:  # an interrupt among the ways out
        keeper.close()
        base_env(model).close()
    return run


def _is_finite(model: OnPolicyAlgorithm) -> bool:
    """Whether a model's parameters are finite, and so are the standard deviations and their inverses."""
    numbers: list[torch.Tensor] = list(model.policy.parameters())
    if hasattr(model.policy, "log_std"):
        numbers += [model.policy.log_std.exp(), (-model.policy.log_std).exp()]
    return all(bool(each.isfinite().all()) for each in numbers)


def _writers(run: RunFolder, steps: int) -> list[KVWriter]:
    """The table and the TensorBoard log, without what a run that was cut off wrote after its last checkpoint."""
    kept = run.path / "progress.csv.kept"  # until the new table has what the old one had
    if run.progress_file.is_file() and not kept.is_file():
        os.replace(run.progress_file, kept)
    rows = read_progress(kept) if kept.is_file() else []
    table = CSVOutputFormat(str(run.progress_file))
    for row in rows:
        if row["time/total_timesteps"] <= steps:
            table.write(dict(row), {})
    kept.unlink(missing_ok=True)
    folder = str(run.path / "tensorboard")
    if steps == 0:
        shutil.rmtree(folder, ignore_errors=True)
    tensorboard = TensorBoardOutputFormat(folder)
    if steps and tensorboard.writer is not None:
        tensorboard.writer.close()  # type: ignore[no-untyped-call]
        tensorboard.writer = SummaryWriter(folder, purge_step=steps + 1)  # type: ignore[no-untyped-call]
    return [table, tensorboard]
