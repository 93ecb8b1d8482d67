"""A search for hyperparameters with Optuna, on seeds that no reported result uses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import optuna
from filelock import FileLock, Timeout
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from gym_mara.agents.algorithms.base import LogRange, Preset, SearchSpace, is_schedule
from gym_mara.agents.algorithms.registry import algorithm
from gym_mara.agents.experiments.local import Say, run_tasks
from gym_mara.agents.runs.evaluation import evaluate_run
from gym_mara.agents.runs.folder import RunConfig
from gym_mara.agents.training.train import preset_of, train
from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.errors import GymMaraError, TrainingDivergedError

_State = optuna.trial.TrialState
FIRST_SEED = 1_000_000
"""Trials train on seeds from here on; results are reported of seeds from 0 on."""

_EVALUATIONS = 10
"""How often a run is evaluated, and may be given up."""


@dataclass(frozen=True)
class Search:
    """What is searched for: the tuned preset of an algorithm on an environment."""

    env: str
    algo: str
    steps: int
    trials: int
    seeds: int
    """How many runs make a trial; its value is their mean."""

    def config(self, seed: int) -> RunConfig:
        """The configuration of one run, on the default backend."""
        every = max(1, self.steps // _EVALUATIONS)
        return RunConfig(
            self.env, self.algo, DEFAULT_BACKEND, self.steps, seed, checkpoint_every=every
        )


def open_study(search: Search, folder: Path) -> optuna.Study:
    """The search in a folder, new or as far as it has come.

    Raises:
        GymMaraError: the folder holds another search.
    """
    start = preset_of(search.config(FIRST_SEED))
    folder = folder.resolve()  # Optuna's lock is a link, which a relative path would leave dangling
    folder.mkdir(parents=True, exist_ok=True)
    study = optuna.create_study(
        study_name="search",
        storage=JournalStorage(JournalFileBackend(str(folder / "study.log"))),
        sampler=optuna.samplers.TPESampler(multivariate=True, constant_liar=True),
        pruner=optuna.pruners.MedianPruner(n_startup_trials=8, n_warmup_steps=_EVALUATIONS // 3),
        load_if_exists=True,
    )
    about = {name: value for name, value in asdict(search).items() if name != "trials"}
    there = study.user_attrs.get("search")
    if there is None:
        study.enqueue_trial(values_of(start, algorithm(search.algo).search_space))
        study.set_user_attr("search", about)
    elif there != about:
        raise GymMaraError(f"{str(folder)!r} holds another search: {there}")
    return study


def run_search(
    search: Search, folder: Path, jobs: int, hear: Callable[[str, Any], None]
) -> dict[str, str]:
    """Search with so many processes; trials that a kill cut off before are tried again.

    Args:
        search: what for.
        folder: of the search.
        jobs: how many processes.
        hear: called with a process's name and how many trials have ended, or None as a trial goes on.

    Returns:
        Process → what went wrong, of those that failed.

    Raises:
        GymMaraError: the folder holds another search, or another process searches there.
    """
    study = open_study(search, folder)
    try:
        with FileLock(folder / ".lock", timeout=0):
            for trial in study.get_trials(deepcopy=False, states=(_State.RUNNING,)):
                study.tell(trial.number, state=_State.FAIL)
                study.enqueue_trial({**trial.system_attrs.get("fixed_params", {}), **trial.params})
            tasks = {f"worker {i}": partial(work, search, folder) for i in range(jobs)}
            return run_tasks(tasks, hear, jobs)
    except Timeout:
        raise GymMaraError(f"another process is searching in {str(folder)!r}") from None


def work(search: Search, folder: Path, say: Say) -> None:
    """Try hyperparameters until the search has as many finished trials as it wants; several processes may."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    study = open_study(search, folder)
    while finished(study) < search.trials:
        study.optimize(partial(_value, search, say), n_trials=1)
        say(finished(study))


def finished(study: optuna.Study) -> int:
    """How many trials have ended, those that were given up early or diverged among them, but not those that a kill ended."""
    return len(study.get_trials(deepcopy=False, states=(_State.COMPLETE, _State.PRUNED)))


def best(study: optuna.Study) -> optuna.trial.FrozenTrial | None:
    """The best trial that went to its end, if there is one."""
    done = study.get_trials(deepcopy=False, states=(_State.COMPLETE,))
    return min(done, key=lambda trial: trial.value or 0.0, default=None)


def _value(search: Search, say: Say, trial: optuna.Trial) -> float:
    """What a trial is worth, the smaller the better: log₁₀ of what its last policies' reward per step falls short of 10."""
    space = algorithm(search.algo).search_space
    chosen = {
        name: trial.suggest_float(name, *values, log=True)
        if isinstance(values, LogRange)
        else trial.suggest_categorical(name, values)
        for name, values in {**space.arguments, **space.policy_kwargs}.items()
    }
    preset = with_values(preset_of(search.config(FIRST_SEED)), space, chosen)
    values: list[float] = []
    told: list[int] = [0]

    def report(_: int, shown: dict[str, float]) -> None:
        say(None)
        # By their number: the steps at which trials are evaluated hang on their rollouts.
        number = int(shown.get("evaluations", 0))
        if number > told[0] and not values:  # the first run decides
            told[0] = number
            trial.report(_shortfall(shown["eval_reward_per_step"]), number)
            if trial.should_prune():
                raise optuna.TrialPruned

    for seed in range(search.seeds):
        config = search.config(FIRST_SEED + 1000 * trial.number + seed)
        with TemporaryDirectory() as folder:
            try:
                run = train(config, Path(folder) / "run", report, preset=preset)
            except TrainingDivergedError as error:
                raise optuna.TrialPruned(str(error)) from error
            reward = float(evaluate_run(run, episodes=1)["reward_per_step"].mean())
        values.append(_shortfall(reward))
    return float(np.mean(values))


def with_values(preset: Preset, space: SearchSpace, chosen: dict[str, Any]) -> Preset:
    """A preset with other values of what a search varies; a schedule is scaled so that it starts at its value."""
    arguments = dict(preset.arguments)
    for name, value in chosen.items():
        if name in space.policy_kwargs:
            arguments["policy_kwargs"] = {**arguments.get("policy_kwargs", {}), name: value}
        elif is_schedule(points := arguments.get(name)):
            arguments[name] = tuple((progress, value * v / points[0][1]) for progress, v in points)
        else:
            arguments[name] = value
    return replace(preset, arguments=arguments)


def values_of(preset: Preset, space: SearchSpace) -> dict[str, Any]:
    """The values that a preset has of what a search varies; of a schedule its first."""
    given = {**preset.arguments, **preset.arguments.get("policy_kwargs", {})}
    found = {
        name: given[name] for name in (*space.arguments, *space.policy_kwargs) if name in given
    }
    return {name: v[0][1] if is_schedule(v) else v for name, v in found.items()}


def _shortfall(reward_per_step: float) -> float:
    return math.log10(max(10.0 - reward_per_step, 1e-9))
