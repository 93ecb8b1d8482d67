"""Checkpoints: any damage is found, nothing in them runs code, and a robot that has changed is refused."""

from __future__ import annotations

import pickle
import shutil
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.runs.config import DamagedRunError
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.runs.policy import base_env, save_policy
from gym_mara.agents.runs.snapshot import decode, encode
from gym_mara.agents.training.checkpoint import STATE_FILE, Progress, restore_state, state_files
from gym_mara.agents.training.train import new_model, preset_of, resume
from gym_mara.envs.statistics import EpisodeStatistics
from tests.agents.conftest import config, silent

REACHED = Progress(best=1.5, elapsed=2.5)


@pytest.fixture
def unfinished(finished_run: RunFolder, tmp_path: Path) -> RunFolder:
    """A run that lacks its last policy."""
    shutil.copytree(finished_run.path, tmp_path / "run")
    shutil.rmtree(tmp_path / "run" / "last")
    return RunFolder.open(tmp_path / "run")


@pytest.mark.parametrize("algo", ["ppo", "trpo", "acktr"])
def test_a_restored_training_has_the_same_state(tmp_path: Path, algo: str) -> None:
    preset = asdict(preset_of(config(algo=algo)))
    model = new_model(config(algo=algo, preset=preset))
    model.learn(600)
    files = state_files(model, REACHED)
    save_policy(tmp_path / "checkpoint", model, files)
    other = new_model(config(algo=algo, preset=preset, seed=9))
    assert state_files(other, REACHED) != files
    assert restore_state(other, tmp_path / "checkpoint") == REACHED
    assert state_files(other, REACHED) == files
    for each in (model, other):
        base_env(each).close()


def test_each_flipped_bit_of_the_state_is_found(unfinished: RunFolder) -> None:
    model = new_model(unfinished.config)
    file = unfinished.checkpoints()[-1] / STATE_FILE
    content, rng = file.read_bytes(), np.random.default_rng(0)
    for place in [*range(60), *rng.integers(0, len(content), 140).tolist()]:
        changed = bytearray(content)
        changed[place] ^= 1 << int(rng.integers(8))
        file.write_bytes(changed)
        with pytest.raises(DamagedRunError, match=r"damaged.*resume from the one before"):
            restore_state(model, file.parent)
    base_env(model).close()


@pytest.mark.parametrize("damage", ["missing", "empty", "cut", "a folder", "a pickle"])
def test_a_damaged_state_is_an_error(unfinished: RunFolder, damage: str) -> None:
    file = unfinished.checkpoints()[-1] / STATE_FILE
    content = file.read_bytes()
    file.unlink()
    if damage == "a folder":
        file.mkdir()
    elif damage != "missing":
        parts = {"empty": b"", "cut": content[:-100], "a pickle": pickle.dumps(_Trap())}
        file.write_bytes(parts[damage])
    with pytest.raises(DamagedRunError, match=r"damaged.*resume from the one before"):
        resume(unfinished.path, silent)


class _Trap:
    """An error if it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return pytest.fail, ("it was unpickled",)


def test_no_pickle_of_a_run_is_read_to_resume_it(
    unfinished: RunFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, lambda *_, **__: pytest.fail("unpickled"))
    assert resume(unfinished.path, silent).has_policy("last")


def test_a_checkpoint_of_an_older_version_is_refused_in_plain_words(unfinished: RunFolder) -> None:
    folder = unfinished.checkpoints()[-1]
    (folder / STATE_FILE).unlink()
    (folder / "state.pkl").write_bytes(pickle.dumps(_Trap()))
    with pytest.raises(DamagedRunError, match=r"older version.*pickle: train the run again"):
        resume(unfinished.path, silent)


def _changed(*path: Any, to: Any) -> Callable[[Any], None]:
    """Change a value in a state."""

    def change(state: Any) -> None:
        *parents, last = path
        for key in parents:
            state = state[key]
        state[last] = to

    return change


HOSTILE: dict[str, Callable[[Any], None]] = {
    "observation NaN": _changed("attributes", "_last_obs", to=np.full((256, 16), np.nan)),
    "observation shape": _changed("attributes", "_last_obs", to=np.zeros((3, 3))),
    "text for steps": _changed("attributes", "num_timesteps", to="abc"),
    "steps of another checkpoint": _changed("attributes", "num_timesteps", to=-(10**6)),
    "updates": _changed("attributes", "_n_updates", to="x"),
    "episodes": _changed("attributes", "ep_info_buffer", to=5),
    "an episode": _changed("attributes", "ep_info_buffer", to=deque([{"r": "x"}])),
    "returns NaN": _changed("returns", to=np.full(256, np.nan)),
    "returns shape": _changed("env", "returns", to=np.zeros(3)),
    "variance": _changed("statistics", "ret_rms", "var", to=np.float64(-1.0)),
    "best": _changed("progress", to=[float("nan"), 1.0]),
    "joint positions NaN": _changed("env", "env", "backend", "q", to=np.full((256, 6), np.nan)),
    "goal": _changed("env", "env", "goal", to=(np.zeros((1, 3)), np.zeros((1, 4)))),
    "statistics": _changed("env", "env", "statistics", to=EpisodeStatistics(3)),
    "generator": _changed("env", "env", "np_random", to=5),
    "ended": _changed("env", "env", "ended", to=np.ones(256)),
}


@pytest.mark.parametrize("change", HOSTILE.values(), ids=HOSTILE)
def test_a_state_with_a_wrong_value_is_an_error(
    unfinished: RunFolder, change: Callable[[Any], None]
) -> None:
    file = unfinished.checkpoints()[-1] / STATE_FILE
    state = decode(file.read_bytes())
    change(state)
    file.write_bytes(encode(state))
    with pytest.raises(DamagedRunError, match="checkpoint"):
        resume(unfinished.path, silent)


@pytest.mark.parametrize("name", ["tensorboard", "learning_curve.png", "last", "checkpoints/1.new"])
def test_nothing_is_written_through_a_link_in_a_run(unfinished: RunFolder, name: str) -> None:
    link = unfinished.path / name
    outside = unfinished.path.parent / "outside"
    outside.mkdir()
    if link.is_dir():
        shutil.rmtree(link)
    link.unlink(missing_ok=True)
    link.symlink_to(outside / "new" if name.endswith(".png") else outside)
    with pytest.raises(DamagedRunError, match="symbolic link"):
        resume(unfinished.path, silent)
    assert not list(outside.iterdir())
