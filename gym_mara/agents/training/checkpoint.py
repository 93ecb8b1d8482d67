"""The state of a training: all that a resumed training needs to give the same result as one that was not interrupted."""

from __future__ import annotations

import random
from collections import deque
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.spaces import Dict, Space
from numpy.typing import NDArray
from sb3_contrib import RecurrentPPO
from sb3_contrib.common.recurrent.type_aliases import RNNStates
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.running_mean_std import RunningMeanStd
from typing_extensions import Buffer

from gym_mara.agents.runs.archive import LARGEST
from gym_mara.agents.runs.config import DamagedRunError
from gym_mara.agents.runs.description import read_description
from gym_mara.agents.runs.policy import base_env, normalisation
from gym_mara.agents.runs.snapshot import decode, encode
from gym_mara.agents.training.replay import (
    REPLAY_FILE,
    buffer_of,
    read_replay,
    replay_contents,
    replay_state,
)
from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError, read_bytes
from gym_mara.snapshots import check_fits

STATE_FILE = "state.bin"
_OLD_STATE_FILE = "state.pkl"
# Attributes of Stable-Baselines3's algorithms that change during a training.
_ATTRIBUTES = (
    "num_timesteps",
    "_n_updates",
    "_episode_num",
    "_current_progress_remaining",
    "_last_obs",
    "_last_original_obs",
    "_last_episode_starts",
    "ep_info_buffer",
    "ep_success_buffer",
)
_STATISTICS = ("obs_rms", "ret_rms")


class Progress(NamedTuple):
    """What a training has reached at a checkpoint."""

    best: float
    """The best evaluation so far, as reward per step."""
    elapsed: float
    """How long it has trained, s."""


def state_files(model: BaseAlgorithm, progress: Progress) -> dict[str, list[Buffer]]:
    """The files of a checkpoint with the state of a training, before a rollout starts: name → the pieces of its content.

    Raises:
        GymMaraError: the environment's snapshot has a value that is not plain.
    """
    wrapped = normalisation(model)
    state = {
        "progress": list(progress),
        "parameters": _plain(model.get_parameters()),
        "attributes": {name: getattr(model, name) for name in _ATTRIBUTES},
        "statistics": {
            name: vars(vars(wrapped)[name]).copy() for name in _STATISTICS if name in vars(wrapped)
        },
        "returns": wrapped.returns,
        "env": base_env(model).save_state(),
        "random": _random_state(),
    }
    if isinstance(model, RecurrentPPO):
        state["memory"] = _memory(model)
    files: dict[str, list[Buffer]] = {}
    if isinstance(model, OffPolicyAlgorithm):
        files[REPLAY_FILE] = replay_contents(buffer_of(model))
        state["off_policy"] = {
            "variables": _plain(variables_of(model)),
            "warm_up": model.action_space.np_random,
            "replay": replay_state(buffer_of(model)),
        }
    return {STATE_FILE: [encode(state)], **files}


def variables_of(model: OffPolicyAlgorithm) -> dict[str, torch.Tensor]:
    """The tensors that a model learns beside its networks, such as the entropy coefficient."""
    _, names = model._get_torch_save_params()
    return {name: getattr(model, name) for name in names}


def restore_state(model: BaseAlgorithm, checkpoint: Path) -> Progress:
    """Set an untrained model with its environment, and the random generators, to the state of a checkpoint.

    Raises:
        DamagedRunError: the checkpoint is damaged or of an older version, or has no replay buffer.
        GymMaraError: the robot has changed since.
    """
    read_description(checkpoint).check(base_env(model).env.simulation)
    if (checkpoint / _OLD_STATE_FILE).exists():
        raise DamagedRunError(
            f"the checkpoint {str(checkpoint)!r} is of an older version of gym_mara, which stored it as a pickle: "
            "train the run again"
        )
    try:
        state = decode(read_bytes(checkpoint / STATE_FILE, 4 * LARGEST))
        _check(model, state)
        if isinstance(model, OffPolicyAlgorithm):
            _restore_off_policy(model, state["off_policy"], checkpoint)
        return _restore(model, state)
    except (
        DamagedFileError,
        ArithmeticError,
        AttributeError,
        LookupError,
        RuntimeError,
        TypeError,
        ValueError,
    ) as error:
        raise DamagedRunError(
            f"the checkpoint {str(checkpoint)!r} is damaged ({error}); delete it to resume from the one before"
        ) from error


def _check(model: BaseAlgorithm, state: Any) -> None:
    """Check all of a state that the environment and torch do not check themselves.

    Raises:
        GymMaraError: a value has another form than in a state of this model, or is out of range.
    """
    wrapped = normalisation(model)
    observation = _batch(model.observation_space, wrapped.num_envs)
    form: dict[str, Any] = {
        "progress": [0.0, 0.0],
        "parameters": dict,
        "attributes": {
            "num_timesteps": 0,
            "_n_updates": 0,
            "_episode_num": 0,
            "_current_progress_remaining": 0.0,
            "_last_obs": observation,
            "_last_original_obs": observation,
            "_last_episode_starts": np.zeros(wrapped.num_envs, np.bool_),
            "ep_info_buffer": deque,
            "ep_success_buffer": deque,
        },
        "statistics": {name: vars(v) for name, v in vars(wrapped).items() if name in _STATISTICS},
        "returns": wrapped.returns,
        "env": {"env": dict, "returns": wrapped.returns},
        "random": list,
    }
    if isinstance(model, RecurrentPPO):
        form["memory"] = _memory(model)
    if isinstance(model, OffPolicyAlgorithm):
        form["off_policy"] = {
            "variables": dict.fromkeys(variables_of(model), torch.Tensor),
            "warm_up": np.random.Generator,
            "replay": replay_state(buffer_of(model)),
        }
    check_fits("state", state, form)
    episodes = state["attributes"]["ep_info_buffer"]
    check_fits("ep_info_buffer", episodes, deque([{"r": 0.0, "l": 0, "t": 0.0}] * len(episodes)))
    for name, running in state["statistics"].items():
        if not (running["count"] > 0.0 and bool(np.all(running["var"] >= 0.0))):
            raise GymMaraError(f"the statistics {name!r} are out of range")


def _batch(space: Space[Any], size: int) -> Any:
    """A batch of observations of a space."""
    if isinstance(space, Dict):
        return {name: _batch(each, size) for name, each in space.items()}
    return np.zeros((size, *(space.shape or ())))


def _restore(model: BaseAlgorithm, state: dict[str, Any]) -> Progress:
    wrapped = normalisation(model)
    model.set_parameters(state["parameters"], exact_match=True, device="cpu")
    for name in _ATTRIBUTES:
        setattr(model, name, state["attributes"][name])
    for name, values in state["statistics"].items():
        running: RunningMeanStd = getattr(wrapped, name)
        vars(running).update(values)
    wrapped.returns = state["returns"]
    if isinstance(model, RecurrentPPO):
        pairs = [tuple(map(torch.from_numpy, each)) for each in state["memory"]]
        model._last_lstm_states = RNNStates(*pairs)
    base_env(model).restore_state(state["env"])
    _restore_random_state(state["random"])
    return Progress(*map(float, state["progress"]))


@torch.no_grad()
def _restore_off_policy(model: OffPolicyAlgorithm, state: dict[str, Any], checkpoint: Path) -> None:
    """Restore what only off-policy algorithms have: tensors beside the networks, and the replay buffer."""
    for name, variable in variables_of(model).items():
        variable.copy_(state["variables"][name])
    model.action_space._np_random = state["warm_up"]  # random actions before the first update
    read_replay(checkpoint / REPLAY_FILE, buffer_of(model), state["replay"])


def _memory(model: RecurrentPPO) -> list[list[NDArray[np.float32]]]:
    """The states of the LSTMs of a recurrent model: of actor and critic, each the hidden and the cell state."""
    states: Any = model._last_lstm_states
    return [[each.numpy() for each in pair] for pair in states]


def _plain(value: Any) -> Any:
    """Parameters with plain dicts in place of ordered ones, and tensors in place of parameters."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(_plain(each) for each in value)
    return value.detach() if isinstance(value, torch.Tensor) else value


def _random_state() -> list[Any]:
    """The state of every random generator that Stable-Baselines3 uses."""
    return [random.getstate(), np.random.get_state(), torch.get_rng_state()]  # noqa: NPY002


def _restore_random_state(state: list[Any]) -> None:
    python_state, numpy_state, torch_state = state
    random.setstate(python_state)
    np.random.set_state(numpy_state)  # noqa: NPY002
    torch.set_rng_state(torch_state)
