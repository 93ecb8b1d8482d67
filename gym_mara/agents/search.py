"""A search for hyperparameters with Optuna, on seeds that no reported result uses."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from gym_mara.agents import presets
from gym_mara.agents.evaluate import evaluate_run
from gym_mara.agents.parallel import Say
from gym_mara.agents.run import RunConfig
from gym_mara.agents.train import train
from gym_mara.errors import GymMaraError, unknown

FIRST_SEED = 1_000_000
"""Trials train on seeds from here on; results are reported of seeds from 0 on."""

# Algorithm → hyperparameter → (lowest, highest), on a logarithmic scale, or a list of what it can be.
SPACES: dict[str, dict[str, tuple[float, float] | list[Any]]] = {
    "ppo": {
        "n_steps": [4, 8, 16],
        "batch_size": [512, 1024],
        "n_epochs": [5, 10],
        "learning_rate": (2e-3, 2e-2),
        "covariance_rate": (0.3, 5.0),
    },
    "trpo": {
        "n_steps": [8, 16, 32],
        "target_kl": (2e-2, 2e-1),
        "cg_damping": (1e-3, 1e-1),
        "covariance_rate": (0.1, 3.0),
    },
    "acktr": {
        "n_steps": [1, 2, 4, 8],
        "learning_rate": (1e-2, 1.0),
        "target_kl": (3e-4, 3e-2),
        "critic_kl": (3e-2, 1.0),
        "damping": (1e-3, 1e-1),
        "fisher_decay": [0.9, 0.95, 0.99],
        "momentum": [0.0, 0.5, 0.9],
        "log_std_init": [-2.0, -1.5, -1.0],
    },
}


_OF_POLICY = ("log_std_init", "covariance_rate")


@dataclass(frozen=True)
class Search:
    """What is searched for: the tuned preset of an algorithm on an environment."""

    env: str
    algo: str
    steps: int
    trials: int
    seeds: int
    """How many runs make a trial; its value is their mean."""


def open_study(search: Search, folder: Path) -> optuna.Study:
    """The search in a folder, new or as far as it has come.

    Raises:
        GymMaraError: the folder holds another search.
    """
    if search.algo not in SPACES:
        raise unknown("algorithm", search.algo, SPACES)
    folder = folder.resolve()  # Optuna's lock is a link, which a relative path would leave dangling
    folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name="search",
        storage=JournalStorage(JournalFileBackend(str(folder / "study.log"))),
        sampler=optuna.samplers.TPESampler(multivariate=True, constant_liar=True),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=8, n_warmup_steps=search.steps // 3),
        load_if_exists=True,
    )
    about = {name: value for name, value in asdict(search).items() if name != "trials"}
    if not study.user_attrs:
        study.enqueue_trial(values_of(search.algo))
    elif study.user_attrs != about:
        raise GymMaraError(f"{str(folder)!r} holds another search: {study.user_attrs}")
    for name, value in about.items():
        study.set_user_attr(name, value)
    return study


def work(search: Search, folder: Path, say: Say) -> None:
    """Try hyperparameters until the search has as many finished trials as it wants; several processes may."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = open_study(search, folder)
    while finished(study) < search.trials:
        study.optimize(partial(_value, search, say), n_trials=1)
        say(finished(study))


def finished(study: optuna.Study) -> int:
    """How many trials have ended, those that were given up early among them."""
    states = optuna.trial.TrialState
    return len(study.get_trials(deepcopy=False, states=(states.COMPLETE, states.PRUNED)))


def _value(search: Search, say: Say, trial: optuna.Trial) -> float:
    """What a trial is worth, the smaller the better: log₁₀ of what its last policies' reward per step falls short of 10."""
    chosen = {}
    for name, space in SPACES[search.algo].items():
        if isinstance(space, list):
            chosen[name] = trial.suggest_categorical(name, space)
        else:
            chosen[name] = trial.suggest_float(name, *space, log=True)
    preset = with_values(presets.preset(search.algo, teleports=True), chosen)
    values: list[float] = []
    last: list[float] = [math.nan]

    def report(steps: int, shown: dict[str, float]) -> None:
        say(None)
        evaluated = shown.get("eval_reward_per_step")
        if evaluated is not None and evaluated != last[0] and not values:  # the first run decides
            last[0] = evaluated
            trial.report(_shortfall(evaluated), steps)
            if trial.should_prune():
                raise optuna.TrialPruned

    for seed in range(search.seeds):
        config = RunConfig(
            search.env,
            search.algo,
            "pinocchio",
            search.steps,
            FIRST_SEED + 1000 * trial.number + seed,
            checkpoint_every=search.steps // 10,
        )
        with TemporaryDirectory() as folder:
            run = train(config, Path(folder) / "run", report, preset=preset)
            reward = float(evaluate_run(run, episodes=1)["reward_per_step"].mean())
        values.append(_shortfall(reward))
    return float(np.mean(values))


def with_values(preset: presets.Preset, chosen: dict[str, Any]) -> presets.Preset:
    """A preset with other values; a learning rate changes over the run as the preset's does."""
    arguments = dict(preset.arguments)
    for name, value in chosen.items():
        if name in _OF_POLICY:
            arguments["policy_kwargs"] = {**arguments["policy_kwargs"], name: value}
        elif name == "learning_rate":
            points = arguments[name]
            arguments[name] = tuple((progress, value * v / points[0][1]) for progress, v in points)
        else:
            arguments[name] = value
    return replace(preset, arguments=arguments)


def values_of(algo: str) -> dict[str, Any]:
    """The values that an algorithm's preset has now, which are tried first."""
    arguments = presets.preset(algo, teleports=True).arguments
    given = {**arguments, **arguments["policy_kwargs"]}
    if isinstance(given["learning_rate"], tuple):
        given["learning_rate"] = given["learning_rate"][0][1]
    return {name: given[name] for name in SPACES[algo] if name in given}


def _shortfall(reward_per_step: float) -> float:
    return math.log10(max(10.0 - reward_per_step, 1e-9))
