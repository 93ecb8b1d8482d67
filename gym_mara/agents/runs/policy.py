"""A policy on disk: the model and the normalisation that it was trained with, in one folder."""

from __future__ import annotations

import io
import json
import pickle
import shutil
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

from gym_mara.agents.algorithms.base import Preset, policy_class
from gym_mara.agents.algorithms.registry import algorithm
from gym_mara.agents.runs.folder import DamagedRunError, RunConfig, replace_folder
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.errors import GymMaraError

# What reading a pickle or a zip that was cut short or overwritten raises; others than ValueError, which tells of a misfit.
DAMAGE = (
    OSError,
    EOFError,
    LookupError,
    AttributeError,
    TypeError,
    ImportError,
    UnicodeDecodeError,
    zipfile.BadZipFile,
    zlib.error,
    pickle.UnpicklingError,
)


def policy_arguments(preset: Preset) -> dict[str, Any]:
    """Keyword arguments of a preset's policy."""
    arguments = dict(preset.arguments.get("policy_kwargs", {}))
    if "optimizer_class" in arguments:
        arguments["optimizer_class"] = getattr(torch.optim, arguments["optimizer_class"])
    return arguments


def save_policy(
    folder: Path, model: OnPolicyAlgorithm, extra: dict[str, bytes] | None = None
) -> None:
    """Write a policy's folder, with other files beside it, so that a kill leaves no half of it behind."""
    temporary = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    model.save(temporary / "model.zip")
    text = json.dumps(_normalisation_values(normalisation(model)), indent=2) + "\n"
    (temporary / "normalisation.json").write_text(text)
    for name, content in (extra or {}).items():
        (temporary / name).write_bytes(content)
    replace_folder(temporary, folder)


def load_policy(
    folder: Path, config: RunConfig, env: MaraVecEnv
) -> tuple[ActorCriticPolicy, VecNormalize]:
    """The policy in a folder, to act on an environment, which may be one whose joints are faster or slower.

    Only numbers are read; nothing is unpickled that could run code.

    Raises:
        DamagedRunError: a file is missing or damaged.
        GymMaraError: the policy is one of another environment.
    """
    preset = Preset(**config.preset)
    make = policy_class(preset.policy)
    arguments = policy_arguments(preset)
    policy = make(env.observation_space, env.action_space, lambda _: 0.0, **arguments)
    with _told(folder):
        with zipfile.ZipFile(folder / "model.zip") as archive, archive.open("policy.pth") as file:
            weights = torch.load(io.BytesIO(file.read()), map_location="cpu", weights_only=True)
        policy.load_state_dict(weights)
        wrapped = _normalised(folder, env, training=False)
    policy.set_training_mode(False)
    return policy, wrapped


def load_model(folder: Path, algo: str, env: MaraVecEnv) -> tuple[OnPolicyAlgorithm, VecNormalize]:
    """The algorithm in a folder, to go on training; reading it unpickles, and a pickle can run any code.

    Raises:
        DamagedRunError: a file is missing or damaged.
        GymMaraError: the policy is one of another environment.
    """
    with _told(folder):
        wrapped = _normalised(folder, env, training=True)
        file = folder / "model.zip"
        model = (
            algorithm(algo).load_class().load(file, env=wrapped, device="cpu", force_reset=False)
        )
    return model, wrapped


@contextmanager
def _told(folder: Path) -> Iterator[None]:
    """Tell in a line what is wrong with a policy's folder."""
    try:
        _check_archive(folder / "model.zip")
        yield
    except DAMAGE as error:
        raise DamagedRunError(f"the policy in {str(folder)!r} is damaged: {error}") from error
    except (ValueError, AssertionError, RuntimeError) as error:
        raise GymMaraError(
            f"the policy in {str(folder)!r} does not fit the environment: {error}"
        ) from error


def _check_archive(file: Path) -> None:
    """Raises one of DAMAGE where an archive is not as it was written."""
    if not zipfile.is_zipfile(file):
        raise zipfile.BadZipFile(f"{file.name} is missing or no zip file")
    try:
        with zipfile.ZipFile(file) as archive:
            broken = archive.testzip()
    except RuntimeError as error:  # a flag that says encrypted, or compressed in another way
        raise zipfile.BadZipFile(f"{file.name}: {error}") from error
    if broken:
        raise zipfile.BadZipFile(f"{file.name}: {broken} is not what was written")


def normalisation(model: OnPolicyAlgorithm) -> VecNormalize:
    """The normalisation that every agent here is wrapped in, whether it normalises or only counts."""
    wrapped: Any = model.get_vec_normalize_env()
    assert isinstance(wrapped, VecNormalize)
    return wrapped


_STATISTICS = {"observation": "obs_rms", "return": "ret_rms"}


def _normalisation_values(wrapped: VecNormalize) -> dict[str, Any]:
    """A normalisation as plain values."""
    values: dict[str, Any] = {
        name: getattr(wrapped, name) for name in ("norm_obs", "norm_reward", "gamma")
    }
    for name, attribute in _STATISTICS.items():
        running = vars(wrapped).get(attribute)  # there only if it is used
        if running is None:
            continue
        mean, variance = np.asarray(running.mean).tolist(), np.asarray(running.var).tolist()
        values[name] = {"mean": mean, "var": variance, "count": float(running.count)}
    return values


def _normalised(folder: Path, env: MaraVecEnv, *, training: bool) -> VecNormalize:
    """The environment in the normalisation of a folder."""
    try:
        values = json.loads((folder / "normalisation.json").read_text())
        read = {name: values.pop(name) for name in _STATISTICS if name in values}
        wrapped = VecNormalize(env, training=training, **values)
        for name, numbers in read.items():
            running = getattr(wrapped, _STATISTICS[name])
            running.mean, running.var = np.array(numbers["mean"]), np.array(numbers["var"])
            running.count = numbers["count"]
    except (TypeError, json.JSONDecodeError) as error:
        raise KeyError(f"normalisation.json: {error}") from error
    return wrapped
