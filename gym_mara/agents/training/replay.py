"""The replay buffer of an off-policy algorithm: hindsight replay, and its file in a checkpoint.

The file holds the arrays of the buffer one after another, and nothing else. Their shapes follow from the run, and their
SHA-256 stands in the state of the checkpoint. Only the last checkpoint of a run has the file, which may be hundreds of MB.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import Buffer

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.sb3 import MaraVecEnv
from gym_mara.envs import MaraGoalVectorEnv
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError, MissingFileError, plain_size, writing

REPLAY_FILE = "replay.bin"
# The arrays of Stable-Baselines3's buffers with a row for each step of all arms; the last two are for hindsight replay.
_ROWS = (
    "observations",
    "next_observations",
    "actions",
    "rewards",
    "dones",
    "timeouts",
    "ep_start",
    "ep_length",
)


def hindsight(env: VecEnv, preset: Preset) -> dict[str, Any]:
    """The arguments of an off-policy algorithm that give it hindsight replay; none where it cannot be used.

    It needs a goal environment whose reward can be computed again for another goal. A dense reward with a penalty for
    collisions cannot: it depends on more than the goals.
    """
    if not (isinstance(env, MaraVecEnv) and isinstance(env.env, MaraGoalVectorEnv)):
        return {}
    if env.env.simulation.reward_needs_info:
        return {}
    # The buffer can be sampled once an episode of an arm has ended.
    longest = env.num_envs * (env.env.max_episode_steps or 0)
    starts = max(preset.arguments.get("learning_starts", 0), longest)
    return {"replay_buffer_class": HerReplayBuffer, "learning_starts": starts}


def buffer_of(model: OffPolicyAlgorithm) -> ReplayBuffer:
    """The replay buffer of a model."""
    assert model.replay_buffer is not None
    return model.replay_buffer


def replay_state(buffer: ReplayBuffer) -> dict[str, Any]:
    """What a checkpoint stores of a replay buffer beside its file, as plain values."""
    digest = hashlib.sha256()
    for piece in replay_contents(buffer):
        digest.update(piece)
    starts = getattr(buffer, "_current_ep_start", None)
    return {
        "position": buffer.pos,
        "full": buffer.full,
        "episode_starts": None if starts is None else starts.copy(),
        "sha256": digest.hexdigest(),
    }


def replay_contents(buffer: ReplayBuffer) -> list[Buffer]:
    """The content of the file of a replay buffer, without a copy."""
    return [_raw(rows) for rows in _filled(buffer)]


def read_replay(file: Path, buffer: ReplayBuffer, state: dict[str, Any]) -> None:
    """Fill an empty replay buffer from its file and from its `replay_state`.

    Raises:
        DamagedFileError: the file is missing, or is not the one that was written.
        GymMaraError: a value is out of range.
    """
    buffer.pos, buffer.full = state["position"], state["full"]
    if not 0 <= buffer.pos < buffer.buffer_size:
        raise GymMaraError(f"the position {buffer.pos} is not in the replay buffer")
    arrays = _filled(buffer)
    try:
        size = plain_size(file)
    except MissingFileError:
        raise DamagedFileError(
            "it has no replay buffer, as only the last checkpoint of a run has one"
        ) from None
    if size != sum(array.nbytes for array in arrays):
        raise DamagedFileError(f"{file.name} has another size than the replay buffer")
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        for array in arrays:
            stream.readinto(_raw(array))
            digest.update(_raw(array))
    if digest.hexdigest() != state["sha256"]:
        raise DamagedFileError(f"the contents of {file.name} have changed")
    starts = state["episode_starts"]
    if starts is not None:
        buffer._current_ep_start = starts  # type: ignore[attr-defined]
        arrays = [*arrays, starts]
    for array in arrays:
        whole = array.dtype.kind == "i"  # of hindsight replay: places in the buffer, and lengths
        valid = (array >= 0) & (array <= buffer.buffer_size) if whole else np.isfinite(array)
        if not valid.all():
            raise GymMaraError("a number in the replay buffer is not finite or out of range")


def remove_replay(checkpoints: Iterable[Path]) -> None:
    """Remove the files of the replay buffers from checkpoints."""
    for checkpoint in checkpoints:
        with writing(checkpoint):
            (checkpoint / REPLAY_FILE).unlink(missing_ok=True)


def _filled(buffer: ReplayBuffer) -> list[NDArray[Any]]:
    """The filled rows of the arrays of a buffer, as views."""
    rows = buffer.buffer_size if buffer.full else buffer.pos
    arrays: list[NDArray[Any]] = []
    for name in _ROWS:
        value: Any = getattr(buffer, name, {})
        parts = value.values() if isinstance(value, dict) else [value]
        arrays += [part[:rows] for part in parts]
    return arrays


def _raw(array: NDArray[Any]) -> Buffer:
    """The bytes of a contiguous array, without a copy."""
    return array.reshape(-1).view(np.uint8).data
