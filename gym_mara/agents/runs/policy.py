"""A policy on disk: a folder with the model and the normalisation that it was trained with."""

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

# The errors from reading a truncated or overwritten pickle or zip. ValueError is not among them: it means that the policy does
# not fit the environment.
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
    """The keyword arguments of a preset's policy network."""
    arguments = dict(preset.arguments.get("policy_kwargs", {}))
    if "optimizer_class" in arguments:
        arguments["optimizer_class"] = getattr(torch.optim, arguments["optimizer_class"])
    return arguments


def save_policy(
    folder: Path, model: OnPolicyAlgorithm, extra: dict[str, bytes] | None = None
) -> None:
    """Write the folder of a policy, with other files in it; after a kill the folder holds the old policy or the new one."""
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
    """Load a policy to act in an environment, whose joints may be faster or slower than in training.

    Only numbers are read. Nothing is unpickled that could run code.

    Raises:
        DamagedRunError: a file is missing or damaged.
        GymMaraError: the policy has other spaces than the environment.
    """
    preset = Preset(**config.preset)
    make = policy_class(preset.policy)
    arguments = policy_arguments(preset)
    policy = make(env.observation_space, env.action_space, lambda _: 0.0, **arguments)
    with _reading(folder):
        with zipfile.ZipFile(folder / "model.zip") as archive, archive.open("policy.pth") as file:
            weights = torch.load(io.BytesIO(file.read()), map_location="cpu", weights_only=True)
        policy.load_state_dict(weights)
        wrapped = _normalised(folder, env, training=False)
    policy.set_training_mode(False)
    return policy, wrapped


def load_model(folder: Path, algo: str, env: MaraVecEnv) -> tuple[OnPolicyAlgorithm, VecNormalize]:
    """Load an agent to resume its training. This unpickles, and a pickle can run any code.

    Raises:
        DamagedRunError: a file is missing or damaged.
        GymMaraError: the policy has other spaces than the environment.
    """
    with _reading(folder):
        wrapped = _normalised(folder, env, training=True)
        file = folder / "model.zip"
        model = (
            algorithm(algo).load_class().load(file, env=wrapped, device="cpu", force_reset=False)
        )
    return model, wrapped


@contextmanager
def _reading(folder: Path) -> Iterator[None]:
    """Turn the errors from reading a policy's folder into errors for the user."""
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
    """Raises one of DAMAGE if an archive is missing, truncated or changed."""
    if not zipfile.is_zipfile(file):
        raise zipfile.BadZipFile(f"{file.name} is missing or not a zip file")
    try:
        with zipfile.ZipFile(file) as archive:
            broken = archive.testzip()
    except RuntimeError as error:  # a changed flag claims encryption or another compression
        raise zipfile.BadZipFile(f"{file.name}: {error}") from error
    if broken:
        raise zipfile.BadZipFile(f"{file.name}: the checksum of {broken} is wrong")


def normalisation(model: OnPolicyAlgorithm) -> VecNormalize:
    """The normalisation around a model's environment; every agent here has one, even if it normalises nothing."""
    wrapped: Any = model.get_vec_normalize_env()
    assert isinstance(wrapped, VecNormalize)
    return wrapped


_STATISTICS = {"observation": "obs_rms", "return": "ret_rms"}


def _normalisation_values(wrapped: VecNormalize) -> dict[str, Any]:
    """A normalisation as JSON values."""
    values: dict[str, Any] = {
        name: getattr(wrapped, name) for name in ("norm_obs", "norm_reward", "gamma")
    }
    for name, attribute in _STATISTICS.items():
        running = vars(wrapped).get(attribute)  # exists only if it is used
        if running is None:
            continue
        mean, variance = np.asarray(running.mean).tolist(), np.asarray(running.var).tolist()
        values[name] = {"mean": mean, "var": variance, "count": float(running.count)}
    return values


def _normalised(folder: Path, env: MaraVecEnv, *, training: bool) -> VecNormalize:
    """The environment with the normalisation from a folder."""
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
