"""Hundreds of damaged runs: each gives the numbers of the whole one, or a GymMaraError, and quickly."""

from __future__ import annotations

import json
import os
import random
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gym_mara.agents.runs import load_policy
from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.agents.runs.policy import base_env
from gym_mara.agents.training.checkpoint import restore_state, state_files
from gym_mara.agents.training.train import new_model
from gym_mara.errors import GymMaraError

LONGEST = 5.0
"""The longest time to read a damaged run, s."""
VALUES: list[Any] = [
    None,
    True,
    -1,
    0,
    1.5,
    10**400,
    1e308,
    float("nan"),
    "text",
    "",
    [],
    {},
    [[[[[[[[[[1]]]]]]]]]],
    {"a": {"b": 1}},
    ["../../etc"],
    "\x00",
]


def flip_bytes(file: Path, rng: random.Random) -> None:
    """Change one to four bytes."""
    content = bytearray(file.read_bytes())
    for _ in range(rng.randint(1, 4)):
        content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    file.write_bytes(content)


def cut(file: Path, rng: random.Random) -> None:
    """Leave the first part of a file, which may be empty."""
    content = file.read_bytes()
    file.write_bytes(content[: rng.randrange(len(content))])


def replace_file(file: Path, rng: random.Random) -> None:
    """Put a folder, a pipe, a link to itself, a long text or nothing in place of a file."""
    file.unlink()
    kinds: list[Callable[[], object]] = [
        file.mkdir,
        lambda: os.mkfifo(file),
        lambda: file.symlink_to(file),
        lambda: file.write_bytes(b"[" * 10**6),
        lambda: None,
    ]
    rng.choice(kinds)()


def replace_value(file: Path, rng: random.Random) -> None:
    """Replace, remove or add a value of a JSON file; in another file, change bytes."""
    if file.suffix != ".json":
        return flip_bytes(file, rng)
    values = json.loads(file.read_text())
    place: Any = values
    while True:
        keys = list(place) if isinstance(place, dict) else range(len(place))
        key = rng.choice(list(keys))
        if isinstance(place[key], (dict, list)) and place[key] and rng.random() < 0.7:
            place = place[key]
            continue
        break
    action = rng.random()
    if action < 0.15:
        del place[key]
    elif action < 0.25 and isinstance(place, dict):
        place["surprise"] = rng.choice(VALUES)
    else:
        place[key] = rng.choice(VALUES)
    file.write_text(json.dumps(values))


MUTATIONS = (flip_bytes, cut, replace_file, replace_value, replace_value, replace_value)


@pytest.fixture(scope="module")
def damage(finished_run: RunFolder, tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A function that damages one of some files of a run's copy, and calls another function with the copy."""
    folder = tmp_path_factory.mktemp("damaged")

    def attempt(seed: int, files: list[str], use: Callable[[RunFolder], object]) -> Any:
        path = folder / str(seed)
        shutil.copytree(finished_run.path, path)
        rng = random.Random(seed)
        mutate, file = rng.choice(MUTATIONS), path / rng.choice(files)
        mutate(file, rng)
        started = time.monotonic()
        try:
            return use(RunFolder.open(path))
        except GymMaraError:
            return None
        finally:
            took = time.monotonic() - started
            shutil.rmtree(path)
            assert took < LONGEST, f"seed {seed}: {mutate.__name__} of {file.name} took {took} s"

    return attempt


def test_a_damaged_policy_acts_as_before_or_is_an_error(
    finished_run: RunFolder, damage: Any
) -> None:
    observations = np.random.default_rng(0).normal(size=(4, 16))

    def targets(run: RunFolder) -> Any:
        return load_policy(run).predict(observations)[0]

    whole, errors = targets(finished_run), 0
    for seed in range(200):
        found = damage(seed, ["config.json", "last/model.zip", "last/policy.json"], targets)
        errors += found is None
        # Another number in policy.json is another policy: then only its actions must be finite.
        assert found is None or np.isfinite(found).all()
        assert found is None or found.shape == whole.shape
    assert errors > 100


def test_a_damaged_table_is_read_or_is_an_error(damage: Any) -> None:
    for seed in range(100):
        damage(seed, ["progress.csv"], lambda run: read_progress(run.progress_file))


def test_a_damaged_checkpoint_is_restored_as_it_was_or_is_an_error(
    finished_run: RunFolder, damage: Any
) -> None:
    model = new_model(finished_run.config)
    last = str(finished_run.checkpoints()[-1].relative_to(finished_run.path))

    def restored(run: RunFolder) -> Any:
        reached = restore_state(model, run.checkpoints()[-1])
        return state_files(model, reached)

    whole, errors = restored(finished_run), 0
    for seed in range(100):
        found = damage(seed, [f"{last}/state.bin", f"{last}/policy.json"], restored)
        errors += found is None
        assert found in (None, whole)
    base_env(model).close()
    assert errors > 60
