"""Pretrained policies: for an environment NAME the file NAME.onnx in this folder, as `gym-mara export` writes it."""

from __future__ import annotations

from pathlib import Path

from gym_mara.errors import GymMaraError, short

__all__ = ["pretrained_file", "pretrained_names"]

_FOLDER = Path(__file__).parent


def pretrained_names() -> list[str]:
    """The names of the environments that have a pretrained policy."""
    return sorted(file.stem for file in _FOLDER.glob("*.onnx"))


def pretrained_file(env: str) -> Path:
    """The file of an environment's pretrained policy, for `gym_mara.deploy.OnnxPolicy`.

    Args:
        env: the name of the environment, such as "MARAReach-v0", or its id.

    Raises:
        GymMaraError: the environment has no pretrained policy.
    """
    name, names = env.rpartition(":")[2].removeprefix("gym_mara/"), pretrained_names()
    if name not in names:
        raise GymMaraError(
            f"there is no pretrained policy for {short(name)}; environments that have one: {', '.join(names) or 'none'}. Choose "
            "one of them, or train a policy and export it"
        )
    return _FOLDER / f"{name}.onnx"
