"""A grid of runs: every algorithm on every environment with every seed, safe to kill and to start again."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from gym_mara.agents.algorithms.registry import DEFAULT_PRESET, algorithm
from gym_mara.agents.experiments.local import Engine, Say
from gym_mara.agents.runs.evaluation import evaluate_run
from gym_mara.agents.runs.folder import (
    POLICIES,
    DamagedRunError,
    RunConfig,
    RunFolder,
    read_progress,
    write_atomically,
)
from gym_mara.agents.training.callbacks import Report
from gym_mara.agents.training.train import resume, train
from gym_mara.backends import DEFAULT_BACKEND, backend_names
from gym_mara.errors import GymMaraError, unknown, whole_number
from gym_mara.tasks import TASKS

_TRAINING = "rollout/reward_per_step"
PATIENCE = 30.0
"""How long a run waits for another process that trains it, such as one whose parent was killed, s."""
NEAR = 10.0
"""A run has learnt to reach once its deterministic policy ends an episode this near, mm."""


@dataclass(frozen=True)
class Grid:
    """What is compared."""

    envs: tuple[str, ...]
    algos: tuple[str, ...]
    seeds: int
    """Runs of each pair, with the seeds 0, 1, …"""
    steps: int
    preset_name: str = DEFAULT_PRESET
    backend: str = DEFAULT_BACKEND
    checkpoint_every: int = 50_000

    def check(self) -> None:
        """Raises GymMaraError where a name is unknown or a number out of range."""
        for env in self.envs:
            if env not in TASKS:
                raise unknown("environment", env, TASKS)
        for algo in self.algos:
            algorithm(algo).preset_pair(self.preset_name)
        if self.backend not in backend_names():
            raise unknown("backend", self.backend, backend_names())
        for names in (self.envs, self.algos):
            if len(set(names)) < len(names):
                raise GymMaraError(f"{', '.join(names)}: name each once")
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
    """Make the folder of a grid, or find it as it was left.

    Raises:
        GymMaraError: a value is wrong, or the folder holds another grid or something else.
    """
    grid.check()
    file = folder / "grid.json"
    if file.is_file():
        there, its_presets = _read(folder)
        differences = [
            f"{name} {before!r} there, {now!r} now"
            for (name, before), now in zip(
                asdict(there).items(), asdict(grid).values(), strict=True
            )
            if before != now
        ]
        if not differences and its_presets != _presets(grid):
            differences = [f"made with other {grid.preset_name!r} presets than there are now"]
        if differences:
            raise GymMaraError(
                f"{str(folder)!r} holds another grid ({'; '.join(differences)}): choose another --out"
            )
        return
    if folder.exists() and not folder.is_dir():
        raise GymMaraError(f"{str(folder)!r} is a file: choose another --out")
    if folder.exists() and any(entry.name != ".grid.json.tmp" for entry in folder.iterdir()):
        raise GymMaraError(f"{str(folder)!r} is neither empty nor a grid: choose another --out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        values = {**asdict(grid), "presets": _presets(grid)}
        write_atomically(file, json.dumps(values, indent=2) + "\n")
    except OSError as error:
        raise GymMaraError(f"cannot write to {str(folder)!r}: {error}") from error


def read_grid(folder: Path) -> Grid:
    """The grid in a folder.

    Raises:
        GymMaraError: there is none, or it is damaged.
    """
    return _read(folder)[0]


def _presets(grid: Grid) -> Any:
    """A grid's presets as they are now, in the form in which a file has them."""
    pairs = {algo: algorithm(algo).preset_pair(grid.preset_name) for algo in grid.algos}
    return json.loads(json.dumps({algo: list(map(asdict, pair)) for algo, pair in pairs.items()}))


def _read(folder: Path) -> tuple[Grid, Any]:
    """A grid, and the presets that it was begun with."""
    try:
        values = json.loads((folder / "grid.json").read_text())
        values |= {name: tuple(values[name]) for name in ("envs", "algos")}
        presets = values.pop("presets")
        return Grid(**values), presets
    except FileNotFoundError:
        raise GymMaraError(f"{str(folder)!r} is no grid: it has no grid.json") from None
    except (ValueError, TypeError, KeyError, OSError) as error:
        raise GymMaraError(f"cannot read grid.json in {str(folder)!r}: {error}") from error


def run_grid(
    folder: Path, grid: Grid, engine: Engine, hear: Callable[[str, Any], None]
) -> dict[str, str]:
    """Train what is not yet trained.

    Args:
        folder: of the grid; every process that trains must find it there.
        grid: what to train.
        engine: what runs the trainings: a number of processes of this machine, say, or a cluster.
        hear: called with a run's name and (its steps, what to show); with a run's name and a string, a notice.

    Returns:
        Run → what went wrong, of those that failed.
    """
    open_grid(folder, grid)
    open_runs = {name: c for name, c in grid.runs().items() if read_result(folder / name) is None}
    folder = folder.absolute()
    tasks = {name: partial(run_one, folder / name, config) for name, config in open_runs.items()}
    return engine(tasks, hear)


def run_one(path: Path, config: RunConfig, say: Say) -> None:
    """Train one run, or go on with it, and write its result; what is damaged is set aside and begun anew.

    Raises:
        GymMaraError: its grid is not here, or another process trains it for longer than PATIENCE.
    """
    if not path.parent.is_dir():
        raise GymMaraError(
            f"{platform.node()} does not find the grid {str(path.parent)!r}: "
            "choose an --out on storage that all machines share"
        )

    def report(steps: int, shown: dict[str, float]) -> None:
        say((steps, dict(shown)))

    lock = FileLock(path.with_name(f".{path.name}.lock"), timeout=PATIENCE)
    try:
        with lock:  # the system frees it when its process is killed
            try:
                result = _result(_trained(path, config, report))
            except DamagedRunError as error:
                aside = _set_aside(path)
                say(f"{error}; set aside as {aside.name!r} and begun anew")
                result = _result(train(config, path, report))
            write_atomically(path / "result.json", json.dumps(result, indent=2) + "\n")
    except Timeout:
        raise GymMaraError(f"another process is training {str(path)!r}; wait for it") from None


def _trained(path: Path, config: RunConfig, report: Report) -> RunFolder:
    if not path.exists():
        return train(config, path, report)
    run = RunFolder.open(path)
    if replace(run.config, preset={}) != config:
        raise DamagedRunError(f"the run {str(path)!r} is not the one that the grid wants")
    if run.has_policy("last"):
        return run
    return resume(path, report)


def _set_aside(path: Path) -> Path:
    number = 1
    while (aside := path.with_name(f"{path.name}.damaged{number}")).exists():
        number += 1
    os.replace(path, aside)
    return aside


def _result(run: RunFolder) -> dict[str, Any]:
    """What a finished run has come to: each policy's evaluation, and how long it took."""
    rows = read_progress(run.progress_file) if run.progress_file.is_file() else []
    if not any(_TRAINING in row for row in rows):
        raise DamagedRunError(f"the run {str(run.path)!r} is damaged: progress.csv holds no curve")
    column = "eval/position_error_mm"
    near = [r["time/total_timesteps"] for r in rows if column in r and r[column] <= NEAR]
    for which in POLICIES:
        if not run.has_policy(which):
            raise DamagedRunError(
                f"the run {str(run.path)!r} is damaged: its {which!r} policy is gone"
            )
    policies = {
        which: {k: float(v.mean()) for k, v in evaluate_run(run, episodes=1, which=which).items()}
        for which in POLICIES
    }
    return {**policies, "steps_to_10_mm": near[0] if near else None, "seconds": run.seconds()}


def read_result(path: Path) -> dict[str, Any] | None:
    """What a run has come to; None if it has not finished."""
    try:
        result = json.loads((path / "result.json").read_text())
        return result if isinstance(result, dict) and {*POLICIES} <= result.keys() else None
    except (OSError, ValueError):
        return None
