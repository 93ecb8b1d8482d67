"""A grid of runs: every algorithm on every environment with every seed. It may be killed and resumed."""

from __future__ import annotations

import json
import os
import platform
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from gym_mara.agents.algorithms.registry import DEFAULT_PRESET, algorithm
from gym_mara.agents.experiments.executor import Executor, OnMessage, Send
from gym_mara.agents.runs.evaluation import evaluate_run
from gym_mara.agents.runs.folder import (
    POLICIES,
    DamagedRunError,
    RunConfig,
    RunFolder,
    read_progress,
    write_atomically,
)
from gym_mara.agents.training.callbacks import OnProgress
from gym_mara.agents.training.train import resume, train
from gym_mara.backends import DEFAULT_BACKEND, backend_names
from gym_mara.errors import GymMaraError, unknown, whole_number
from gym_mara.tasks import task_names

_TRAINING = "rollout/reward_per_step"
PATIENCE = 30.0
"""How long to wait for another process that trains the same run, s; for example one whose parent was just killed."""
REACHED = 10.0
"""A run has learnt to reach once its deterministic policy ends an episode within this distance of the target, mm."""


@dataclass(frozen=True)
class Grid:
    """What to train: every algorithm on every environment with every seed."""

    envs: tuple[str, ...]
    algos: tuple[str, ...]
    seeds: int
    """The number of runs of each pair, with the seeds 0, 1, …"""
    steps: int
    preset_name: str = DEFAULT_PRESET
    backend: str = DEFAULT_BACKEND
    checkpoint_every: int = 50_000

    def check(self) -> None:
        """Raises GymMaraError if a name is unknown or given twice, or a number is out of range."""
        for env in self.envs:
            if env not in task_names():
                raise unknown("environment", env, task_names())
        for algo in self.algos:
            algorithm(algo).preset_pair(self.preset_name)
        if self.backend not in backend_names():
            raise unknown("backend", self.backend, backend_names())
        for names in (self.envs, self.algos):
            if len(set(names)) < len(names):
                raise GymMaraError(f"{', '.join(names)}: give each name once")
        for name in ("seeds", "steps", "checkpoint_every"):
            whole_number(name, getattr(self, name))

    def runs(self) -> dict[str, RunConfig]:
        """Name → run."""
        return {
            f"{env}_{algo}_{seed}": RunConfig(
                env,
                algo,
                self.backend,
                self.steps,
                seed,
                checkpoint_every=self.checkpoint_every,
                preset_name=self.preset_name,
            )
            for seed in range(self.seeds)
            for env in self.envs
            for algo in self.algos
        }


def open_grid(folder: Path, grid: Grid) -> None:
    """Make the folder of a grid, or check that an existing folder holds this grid.

    Raises:
        GymMaraError: a value is wrong, or the folder holds another grid or other files.
    """
    grid.check()
    file = folder / "grid.json"
    if file.is_file():
        existing, presets = _read(folder)
        differences = [
            f"{name} {before!r} there, {now!r} now"
            for (name, before), now in zip(
                asdict(existing).items(), asdict(grid).values(), strict=True
            )
            if before != now
        ]
        if not differences and presets != _presets(grid):
            differences = [f"the {grid.preset_name!r} presets have changed since"]
        if differences:
            raise GymMaraError(
                f"{str(folder)!r} holds another grid ({'; '.join(differences)}): choose another --out"
            )
        return
    if folder.exists() and not folder.is_dir():
        raise GymMaraError(f"{str(folder)!r} is a file: choose another --out")
    if folder.exists() and any(entry.name != ".grid.json.tmp" for entry in folder.iterdir()):
        raise GymMaraError(f"{str(folder)!r} holds files but no grid: choose another --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        values = {**asdict(grid), "presets": _presets(grid)}
        write_atomically(file, json.dumps(values, indent=2) + "\n")
    except OSError as error:
        raise GymMaraError(f"cannot write to {str(folder)!r}: {error}") from error


def read_grid(folder: Path) -> Grid:
    """The grid in a folder.

    Raises:
        GymMaraError: the folder holds no grid, or grid.json is damaged.
    """
    return _read(folder)[0]


def _presets(grid: Grid) -> Any:
    """A grid's presets as they are now, as JSON values."""
    pairs = {algo: algorithm(algo).preset_pair(grid.preset_name) for algo in grid.algos}
    return json.loads(json.dumps({algo: list(map(asdict, pair)) for algo, pair in pairs.items()}))


def _read(folder: Path) -> tuple[Grid, Any]:
    """A grid, and the presets that it was started with."""
    try:
        values = json.loads((folder / "grid.json").read_text())
        values |= {name: tuple(values[name]) for name in ("envs", "algos")}
        presets = values.pop("presets")
        return Grid(**values), presets
    except FileNotFoundError:
        raise GymMaraError(f"{str(folder)!r} holds no grid: there is no grid.json") from None
    except (ValueError, TypeError, KeyError, OSError) as error:
        raise GymMaraError(f"cannot read grid.json in {str(folder)!r}: {error}") from error


def run_grid(folder: Path, grid: Grid, executor: Executor, on_message: OnMessage) -> dict[str, str]:
    """Train the runs of a grid that have not finished.

    Args:
        folder: of the grid; every machine that trains must see it under this path.
        grid: what to train.
        executor: runs the trainings, for example in processes of this machine or on a cluster.
        on_message: called with a run's name and either its progress, (steps, values to show), or a notice, a string.

    Returns:
        Name of the run → reason, for each that failed.
    """
    open_grid(folder, grid)
    folder = folder.absolute()
    jobs = {
        name: partial(run_one, folder / name, config)
        for name, config in grid.runs().items()
        if read_result(folder / name) is None
    }
    return executor(jobs, on_message)


def run_one(path: Path, config: RunConfig, send: Send) -> None:
    """Train or resume one run, and write its result; a damaged run is renamed and trained again.

    Raises:
        GymMaraError: this machine does not see the grid, or another process trains the run for longer than PATIENCE.
    """
    if not path.parent.is_dir():
        raise GymMaraError(
            f"{platform.node()} does not see the grid {str(path.parent)!r}: "
            "choose an --out on storage that all machines share"
        )

    def on_progress(steps: int, shown: dict[str, float]) -> None:
        send((steps, dict(shown)))

    lock = FileLock(path.with_name(f".{path.name}.lock"), timeout=PATIENCE)
    try:
        with lock:  # the operating system releases it if this process is killed
            try:
                result = _result(_trained(path, config, on_progress))
            except DamagedRunError as error:
                renamed = _set_aside(path)
                send(f"{error}; renamed to {renamed.name!r} and trained again")
                result = _result(train(config, path, on_progress))
            write_atomically(path / "result.json", json.dumps(result, indent=2) + "\n")
    except Timeout:
        raise GymMaraError(f"another process is training {str(path)!r}; wait for it") from None


def _trained(path: Path, config: RunConfig, on_progress: OnProgress) -> RunFolder:
    """The run, trained to its end."""
    if not path.exists():
        return train(config, path, on_progress)
    run = RunFolder.open(path)
    if replace(run.config, preset={}) != config:
        raise DamagedRunError(f"the run {str(path)!r} has another configuration than the grid")
    if run.has_policy("last"):
        return run
    return resume(path, on_progress)


def _set_aside(path: Path) -> Path:
    """Rename a damaged run; its new path."""
    number = 1
    while (renamed := path.with_name(f"{path.name}.damaged{number}")).exists():
        number += 1
    os.replace(path, renamed)
    return renamed


def _result(run: RunFolder) -> dict[str, Any]:
    """The result of a finished run: the metrics of each policy, and how long the training took."""
    rows = read_progress(run.progress_file) if run.progress_file.is_file() else []
    if not any(_TRAINING in row for row in rows):
        raise DamagedRunError(
            f"the run {str(run.path)!r} is damaged: progress.csv holds no training rewards"
        )
    column = "eval/position_error_mm"
    reached = [r["time/total_timesteps"] for r in rows if column in r and r[column] <= REACHED]
    for which in POLICIES:
        if not run.has_policy(which):
            raise DamagedRunError(
                f"the run {str(run.path)!r} is damaged: its {which!r} policy is missing"
            )
    policies = {
        which: {k: float(v.mean()) for k, v in evaluate_run(run, episodes=1, which=which).items()}
        for which in POLICIES
    }
    return {**policies, "steps_to_10_mm": reached[0] if reached else None, "seconds": run.seconds()}


def read_result(path: Path) -> dict[str, Any] | None:
    """The result of a run; None if it has not finished."""
    try:
        result = json.loads((path / "result.json").read_text())
        return result if isinstance(result, dict) and {*POLICIES} <= result.keys() else None
    except (OSError, ValueError):
        return None
