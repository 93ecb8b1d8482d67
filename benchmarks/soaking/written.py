"""Scenarios of what is written: data sets of both formats, and exported policies."""

from __future__ import annotations

import hashlib
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import minari
import numpy as np
import pandas
from gymnasium.vector.utils import batch_space

from gym_mara.agents.export.run import export
from gym_mara.agents.runs.evaluation import make_arms
from gym_mara.agents.runs.folder import RunConfig, RunFolder
from gym_mara.agents.runs.policy import load_policy
from gym_mara.agents.training.train import train
from gym_mara.datasets.formats import FORMATS
from gym_mara.datasets.playing import record
from gym_mara.datasets.sources import baseline
from gym_mara.deploy import OnnxPolicy
from gym_mara.registration import ENVIRONMENTS
from soaking.environments import EPISODE, SPEED
from soaking.tally import Scenario, Tally

ENV = "MARAReach-v0"
_PREDICTIONS = 50
_SAME = 1e-5
"""How far an action of the exported policy is from that of the run's at most; rounding alone is less."""


def recordings(seed: int, tally: Tally, *, form: str, episodes: int, pixels: int | None) -> None:
    """Records the same episodes twice; every byte must be the same, and nothing else be left."""
    source = baseline("ik", ENV, "pinocchio", {"max_joint_velocity": SPEED})
    written = []
    with tempfile.TemporaryDirectory() as folder:
        for parent in (Path(folder, "one"), Path(folder, "two")):
            parent.mkdir()
            made = parent / "reach-v0"
            done = record(source, form, made, episodes=episodes, seed=seed, pixels=pixels)
            tally.done["steps"] += done.steps
            tally.done["pictures"] += 0 if pixels is None else done.steps + episodes
            tally.done["files"] += 1
            tally.wrong["left files"] += int([*parent.iterdir()] != [made])
            tally.wrong["NaN"] += int(not _finite(made, form))
            written.append(_bytes(made))
    tally.compare(*written)


def _finite(folder: Path, form: str) -> bool:
    """Whether the numbers of a data set, as the format's library reads them, are finite."""
    values: list[Any] = []
    if form == "minari":
        for episode in minari.MinariDataset(folder / "data").iterate_episodes():
            seen: Any = episode.observations
            values += [seen["state"] if isinstance(seen, dict) else seen]
            values += [episode.actions, episode.rewards]
    else:
        for file in (folder / "data").rglob("*.parquet"):
            table = pandas.read_parquet(file)
            values += [np.stack(table[name]) for name in ("observation.state", "action")]
            values += [table["next.reward"]]
    return bool(values) and all(np.isfinite(each).all() for each in values)


def _bytes(folder: Path) -> dict[str, str]:
    """The digest of each file of a folder."""
    return {
        str(file.relative_to(folder)): hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


def exports(seed: int, tally: Tally, *, run: RunFolder) -> None:
    """Exports a policy twice; the files must be equal, and act as the run's policy does."""
    env = make_arms(run.config.env, run.config.backend, 1, run.config.env_options)
    space = batch_space(env.single_observation_space, _PREDICTIONS)
    env.close()
    space.seed(seed)
    observed = space.sample()
    expected, _ = load_policy(run).predict(observed)
    files, actions = [], []
    with tempfile.TemporaryDirectory() as folder:
        for name in ("one.onnx", "two.onnx"):
            export(run, Path(folder, name))
            files.append(Path(folder, name).read_bytes())
            actions.append(OnnxPolicy(Path(folder, name)).predict(observed)[0])
            tally.done["files"] += 1
            tally.wrong["NaN"] += int(not np.isfinite(actions[-1]).all())
        tally.wrong["left files"] += int(len([*Path(folder).iterdir()]) != 2)
    tally.compare(*files)
    tally.compare(*actions)
    tally.done["comparisons"] += 1
    tally.wrong["other result"] += int(np.abs(actions[0] - expected).max() > _SAME)


def scenarios(folder: Path) -> dict[str, Scenario]:
    """Name → scenario. A run is trained in a folder first, whose policy they export."""
    # The recorded episodes are short, as all others.
    ENVIRONMENTS[ENV] = ENVIRONMENTS[ENV]._replace(max_episode_steps=EPISODE)
    run = train(RunConfig(ENV, "ppo", "pinocchio", 512, 0), folder / "run", lambda *_: None)
    found: dict[str, Scenario] = {"export to ONNX": partial(exports, run=run)}
    for form in FORMATS:
        found[f"data set, {form}"] = partial(recordings, form=form, episodes=3, pixels=None)
        found[f"data set, {form}, with pictures"] = partial(
            recordings, form=form, episodes=1, pixels=32
        )
    return found
