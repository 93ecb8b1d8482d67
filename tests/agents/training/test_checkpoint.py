"""Checkpoints: any damage is found, nothing in them runs code, and a robot that has changed is refused."""

from __future__ import annotations

import pickle
import shutil
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from gym_mara.agents.runs.config import DamagedRunError
from gym_mara.agents.runs.folder import RunFolder
from gym_mara.agents.runs.policy import base_env, save_policy
from gym_mara.agents.training.checkpoint import STATE_FILE, Progress, encoded_state, restore_state
from gym_mara.agents.training.train import new_model, preset_of, resume
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
    state = encoded_state(model, REACHED)
    save_policy(tmp_path / "checkpoint", model, {STATE_FILE: state})
    other = new_model(config(algo=algo, preset=preset, seed=9))
    assert encoded_state(other, REACHED) != state
    assert restore_state(other, tmp_path / "checkpoint") == REACHED
    assert encoded_state(other, REACHED) == state
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
    (folder / STATE_FILE).rename(folder / "state.pkl")
    with pytest.raises(DamagedRunError, match=r"older version.*pickle: train the run again"):
        resume(unfinished.path, silent)
