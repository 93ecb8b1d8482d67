"""A search for hyperparameters with Optuna. It trains on seeds that no reported result uses."""

from __future__ import annotations

import inspect
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import optuna
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend

from gym_mara.agents.algorithms.base import (
    LogRange,
    Preset,
    SearchSpace,
    Values,
    is_schedule,
    policy_class,
)
from gym_mara.agents.algorithms.registry import DEFAULT_PRESET, algorithm
from gym_mara.agents.experiments.executor import OnMessage, Send
from gym_mara.agents.experiments.grid import MOST_SEEDS, MOST_STEPS, RANDOM_EPISODES
from gym_mara.agents.experiments.local_executor import run_in_processes
from gym_mara.agents.runs.config import check_backend
from gym_mara.agents.runs.evaluation import episodes_to_judge, evaluate_run
from gym_mara.agents.runs.folder import RunConfig
from gym_mara.agents.training.train import preset_of, train
from gym_mara.errors import GymMaraError, TrainingDivergedError, short, unknown, whole_number
from gym_mara.files import (
    BusyError,
    DamagedFileError,
    MissingFileError,
    locked,
    read_bytes,
    writing,
    written_aside,
)
from gym_mara.registration import environment_names, own_backend

_State = optuna.trial.TrialState
FIRST_SEED = 1_000_000
"""Trials train on seeds from here on; reported results use seeds from 0 on."""
MOST_TRIALS = 100_000
_LOG, _LARGEST_LOG = "study.log", 2**28
"""Optuna's log of the trials, and its largest size, bytes."""
_EVALUATIONS = 10
"""How often a run is evaluated; after each evaluation its trial may be pruned."""


@dataclass(frozen=True)
class Search:
    """What to search: the hyperparameters of an algorithm on an environment, starting from the default preset."""

    env: str
    algo: str
    steps: int
    trials: int
    seeds: int
    """How many runs make a trial; its value is their mean."""

    def check(self) -> None:
        """Raises GymMaraError if a name is unknown or a number is out of range."""
        if self.env not in environment_names():
            raise unknown("environment", self.env, environment_names())
        algorithm(self.algo)
        check_backend(own_backend(self.env))
        for name, most in (("steps", MOST_STEPS), ("trials", MOST_TRIALS), ("seeds", MOST_SEEDS)):
            if whole_number(name, value := getattr(self, name)) > most:
                raise GymMaraError(f"{name} must be at most {most:,}, not {short(value)}")

    def config(self, seed: int) -> RunConfig:
        """The configuration of one run, on the backend of the environment."""
        every = max(1, self.steps // _EVALUATIONS)
        return RunConfig(
            self.env, self.algo, own_backend(self.env), self.steps, seed, checkpoint_every=every
        )


def open_study(search: Search, folder: Path) -> optuna.Study:
    """The study of a search in its folder, new or with the trials so far.

    Raises:
        GymMaraError: a value is wrong, the folder holds another search or other files, its log is damaged, or it cannot be written.
    """
    search.check()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    start = preset_of(search.config(FIRST_SEED))
    _check_folder(folder)
    with writing(folder):
        # Resolved because Optuna's lock is a symbolic link, and a relative path would break it.
        folder = folder.resolve()
        folder.mkdir(parents=True, exist_ok=True)
    _check_log(folder)
    optuna.logging.set_verbosity(optuna.logging.WARNING)  # no line for each trial
    with _replayed(folder / _LOG):
        study = optuna.create_study(
            study_name="search",
            storage=JournalStorage(JournalFileBackend(str(folder / _LOG))),
            sampler=optuna.samplers.TPESampler(multivariate=True, constant_liar=True),
            pruner=optuna.pruners.MedianPruner(
                n_startup_trials=8, n_warmup_steps=_EVALUATIONS // 3
            ),
            load_if_exists=True,
        )
        wanted = {name: value for name, value in asdict(search).items() if name != "trials"}
        existing = study.user_attrs.get("search")
        if existing is None:
            study.enqueue_trial(start_values(start, search.algo))
            study.set_user_attr("search", wanted)
        best_trial(study)  # reads all trials
    if existing not in (None, wanted):
        raise GymMaraError(
            f"{str(folder)!r} holds another search, {short(existing)}: choose another --out"
        )
    return study


def _check_folder(folder: Path) -> None:
    """Raises GymMaraError if this is a file, or a folder with files but without the log of a search."""
    if folder.exists() and not folder.is_dir():
        raise GymMaraError(f"{str(folder)!r} is a file: choose another --out")
    if not folder.exists() or os.path.lexists(folder / _LOG):
        return
    if any(not entry.name.startswith((".lock", f"{_LOG}.")) for entry in folder.iterdir()):
        raise GymMaraError(f"{str(folder)!r} holds files but no search: choose another --out")


def _check_log(folder: Path) -> None:
    """Check the log of a search, if there is one, and remove a last line that a kill or a full disk has cut.

    Raises:
        DamagedFileError: the log is not a plain file, or is too large.
    """
    log = folder / _LOG
    if log.is_symlink():
        raise DamagedFileError(
            f"{str(log)!r} is a symbolic link, not a plain file: choose another --out"
        )
    try:
        text = read_bytes(log, _LARGEST_LOG)
    except MissingFileError:
        return
    if text and not text.endswith(b"\n"):
        # A search that holds the lock may be writing this line now.
        with suppress(BusyError), locked(folder / ".lock", "busy"), written_aside(log) as aside:
            aside.write_bytes(text[: text.rfind(b"\n") + 1])


@contextmanager
def _replayed(log: Path) -> Iterator[None]:
    """Turn what Optuna raises while it reads a log into a GymMaraError that names it."""
    with writing(log):
        try:
            yield
        except (GymMaraError, OSError):
            raise
        except Exception as error:  # a hostile log can fail anywhere in Optuna
            raise DamagedFileError(
                f"the log {str(log)!r} is damaged ({type(error).__name__}: {short(error)}): choose another --out"
            ) from error


def run_search(
    search: Search, folder: Path, processes: int, on_message: OnMessage
) -> dict[str, str]:
    """Run the trials of a search in several processes; trials that a kill interrupted earlier are repeated.

    Args:
        search: what to search.
        folder: of the search.
        processes: how many run trials at a time.
        on_message: called with a process's name and the number of finished trials, or None while a trial goes on.

    Returns:
        Name of the process → reason, for each that failed.

    Raises:
        GymMaraError: the folder holds another search, or another command searches there.
    """
    study = open_study(search, folder)
    busy = f"another process is searching in {str(folder)!r}: wait for it, or choose another --out"
    with locked(folder / ".lock", busy):
        with _replayed(folder / _LOG):
            for trial in study.get_trials(deepcopy=False, states=(_State.RUNNING,)):
                study.tell(trial.number, state=_State.FAIL)
                study.enqueue_trial({**trial.system_attrs.get("fixed_params", {}), **trial.params})
        job = partial(run_trials, search, folder)
        jobs = {f"worker {number}": job for number in range(min(processes, search.trials))}
        return run_in_processes(jobs, on_message, processes)


def run_trials(search: Search, folder: Path, send: Send) -> None:
    """Run trials until the search has enough finished ones; several processes may do so."""
    study = open_study(search, folder)
    while finished_trials(study) < search.trials:
        with writing(folder / _LOG):
            study.optimize(partial(_value, search, send), n_trials=1)
        send(finished_trials(study))


def finished_trials(study: optuna.Study) -> int:
    """How many trials have finished, including those that were pruned or diverged, but not those that were killed."""
    return len(study.get_trials(deepcopy=False, states=(_State.COMPLETE, _State.PRUNED)))


def best_trial(study: optuna.Study) -> optuna.trial.FrozenTrial | None:
    """The best of the trials that were not pruned, if there is one."""
    done = study.get_trials(deepcopy=False, states=(_State.COMPLETE,))
    return min(done, key=lambda trial: trial.value or 0.0, default=None)


def _value(search: Search, send: Send, trial: optuna.Trial) -> float:
    """Train the runs of a trial; the mean shortfall of their last policies."""
    preset = _suggested(search, trial)
    episodes = episodes_to_judge(search.config(FIRST_SEED), RANDOM_EPISODES)
    shortfalls: list[float] = []
    reported = 0

    def on_progress(_: int, shown: dict[str, float]) -> None:
        nonlocal reported
        send(None)
        # Trials are compared by the number of the evaluation, because its step depends on the length of a rollout.
        number = int(shown.get("evaluations", 0))
        if number > reported and not shortfalls:  # only the first run of a trial may prune it
            reported = number
            trial.report(_shortfall(shown["eval_reward_per_step"]), number)
            if trial.should_prune():
                raise optuna.TrialPruned

    for seed in range(search.seeds):
        config = search.config(FIRST_SEED + 1000 * trial.number + seed)
        with TemporaryDirectory() as folder:
            try:
                run = train(config, Path(folder) / "run", on_progress, preset=preset)
            except TrainingDivergedError as error:
                raise optuna.TrialPruned(str(error)) from error
            reward = float(evaluate_run(run, episodes=episodes)["reward_per_step"].mean())
        shortfalls.append(_shortfall(reward))
    return float(np.mean(shortfalls))


def _suggested(search: Search, trial: optuna.Trial) -> Preset:
    """The preset of a trial, with the values that the sampler suggests."""
    start = preset_of(search.config(FIRST_SEED))
    space = space_around(start, search.algo)
    chosen = {
        name: trial.suggest_float(name, *values, log=True)
        if isinstance(values, LogRange)
        else trial.suggest_categorical(name, values)
        for name, values in {**space.arguments, **space.policy_kwargs}.items()
    }
    return with_values(start, space, chosen)


def space_around(start: Preset, algo: str) -> SearchSpace:
    """The search space of an algorithm around the preset with which a search starts.

    A range that does not contain the value of the preset is moved there, and a list gets it. If the preset has a policy of another
    form than the space is for, only those hyperparameters of the policy are varied that the preset has.
    """
    entry = algorithm(algo)
    space = entry.search_space
    there, given = start_values(start, algo), values_of(start, space)
    usual = entry.preset(DEFAULT_PRESET, teleports=True).policy == start.policy

    def around(name: str, values: Values) -> Values:
        if name not in there:
            return values
        value = there[name]
        if not isinstance(values, LogRange):
            return values if value in values else [*values, value]
        if values.low <= value <= values.high:
            return values
        half = math.sqrt(values.high / values.low)
        return LogRange(value / half, value * half)

    return SearchSpace(
        {name: around(name, values) for name, values in space.arguments.items()},
        {n: around(n, v) for n, v in space.policy_kwargs.items() if usual or n in given},
    )


def with_values(preset: Preset, space: SearchSpace, chosen: dict[str, Any]) -> Preset:
    """A preset with the values of a trial; a schedule is scaled so that it starts at its value."""
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
    """The values that a preset has for the hyperparameters of a search space; for a schedule its first value."""
    given = {**preset.arguments, **preset.arguments.get("policy_kwargs", {})}
    found = {
        name: given[name] for name in (*space.arguments, *space.policy_kwargs) if name in given
    }
    return {name: v[0][1] if is_schedule(v) else v for name, v in found.items()}


def start_values(preset: Preset, algo: str) -> dict[str, Any]:
    """The values with which a search starts: those of the preset, and what it leaves out as the algorithm and its network have it."""
    space = algorithm(algo).search_space
    found = values_of(preset, space)
    for make, varied in (
        (algorithm(algo).load_class(), space.arguments),
        (policy_class(preset.policy), space.policy_kwargs),
    ):
        parameters = inspect.signature(make).parameters
        for name in varied.keys() - found.keys() & parameters.keys():
            value = parameters[name].default
            if type(value) in (int, float) and (
                value > 0 or not isinstance(varied[name], LogRange)
            ):
                found[name] = value
    return found


def _shortfall(reward_per_step: float) -> float:
    """log₁₀ of how far a reward per step is below 10, the highest of the paper's tasks; a search minimises it."""
    return math.log10(max(10.0 - reward_per_step, 1e-9))


def reward_of(value: float) -> float:
    """The reward per step of a trial with this value."""
    return 10.0 - 10.0**value
