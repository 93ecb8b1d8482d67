"""A policy on disk: the model and the normalisation that it was trained with, in one folder."""

from __future__ import annotations

import pickle
import shutil
import zipfile
from pathlib import Path
from typing import Any

from stable_baselines3 import PPO
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy
from stable_baselines3.common.vec_env import VecNormalize

from gym_mara.agents.natural_gaussian import NaturalGaussianPolicy
from gym_mara.agents.run import replace_folder
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.errors import GymMaraError, unknown

# What reading a pickle or a zip that was cut short or overwritten raises.
DAMAGE = (OSError, EOFError, KeyError, AttributeError, zipfile.BadZipFile, pickle.UnpicklingError)

ALGORITHMS: dict[str, type[OnPolicyAlgorithm]] = {"ppo": PPO}
POLICY_CLASSES: dict[str, type[ActorCriticPolicy]] = {
    "mlp": ActorCriticPolicy,
    "natural": NaturalGaussianPolicy,
}


def algorithm_class(name: str) -> type[OnPolicyAlgorithm]:
    """The class of an algorithm.

    Raises:
        GymMaraError: there is no such algorithm.
    """
    if name not in ALGORITHMS:
        raise unknown("algorithm", name, ALGORITHMS)
    return ALGORITHMS[name]


def save_policy(
    folder: Path, model: OnPolicyAlgorithm, extra: dict[str, bytes] | None = None
) -> None:
    """Write a policy's folder, with other files beside it, so that a kill leaves no half of it behind."""
    temporary = folder.with_name(f".{folder.name}.tmp")
    shutil.rmtree(temporary, ignore_errors=True)
    temporary.mkdir(parents=True)
    model.save(temporary / "model.zip")
    normalisation(model).save(str(temporary / "normalisation.pkl"))
    for name, content in (extra or {}).items():
        (temporary / name).write_bytes(content)
    replace_folder(temporary, folder)


def load_policy(
    folder: Path, algo: str, env: MaraVecEnv, *, training: bool
) -> tuple[OnPolicyAlgorithm, VecNormalize]:
    """Read a policy's folder and join it to an environment.

    Raises:
        GymMaraError: a file is missing or damaged, or the policy is one of another environment.
    """
    try:
        wrapped = VecNormalize.load(str(folder / "normalisation.pkl"), env)
        wrapped.training = training
        # To act it needs no environment, and may come from one whose joints are faster or slower.
        model = algorithm_class(algo).load(
            folder / "model.zip",
            env=wrapped if training else None,
            device="cpu",
            force_reset=False,
        )
        for mine, theirs in (
            (model.observation_space, env.observation_space),
            (model.action_space, env.action_space),
        ):
            if mine.shape != theirs.shape:
                raise ValueError(f"the policy's space is {mine}, the environment's {theirs}")
    except GymMaraError:
        raise
    except DAMAGE as error:
        raise GymMaraError(f"the policy in {str(folder)!r} is damaged: {error}") from error
    except (ValueError, AssertionError) as error:
        raise GymMaraError(
            f"the policy in {str(folder)!r} does not fit the environment: {error}"
        ) from error
    return model, wrapped


def normalisation(model: OnPolicyAlgorithm) -> VecNormalize:
    """The normalisation that every agent here is wrapped in, whether it normalises or only counts."""
    wrapped: Any = model.get_vec_normalize_env()
    assert isinstance(wrapped, VecNormalize)
    return wrapped
