"""A grid of runs: every algorithm on every environment with every seed. It may be killed and resumed."""

from __future__ import annotations

import json
import math
import os
import platform
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, cast

from annotated_types import Ge, MaxLen
from pydantic import ConfigDict, FiniteFloat
from typing_extensions import TypedDict

from gym_mara.agents.algorithms.registry import DEFAULT_PRESET, algorithm
from gym_mara.agents.experiments.executor import Executor, OnMessage, Send
from gym_mara.agents.runs.config import check_backend
from gym_mara.agents.runs.evaluation import episodes_to_judge, evaluate_run
from gym_mara.agents.runs.folder import (
    POLICIES,
    DamagedRunError,
    RunConfig,
    RunFolder,
    read_progress,
)
from gym_mara.agents.training.callbacks import OnProgress
from gym_mara.agents.training.train import resume, train
from gym_mara.backends import DEFAULT_BACKEND
from gym_mara.errors import GymMaraError, short, unknown, whole_number
from gym_mara.files import (
    DamagedFileError,
    MissingFileError,
    locked,
    read_json,
    write_json,
    writing,
)
from gym_mara.registration import environment_names, file_name

_TRAINING = "rollout/reward_per_step"
PATIENCE = 30.0
"""How long to wait for another process that trains the same run, s; for example one whose parent was just killed."""
REACHED = 10.0
"""A run has learnt to reach once its deterministic policy ends an episode within this distance of the target, mm."""
RANDOM_EPISODES = 100
"""How many episodes measure a finished run where they are random; where all are the same, it is one."""
MOST_SEEDS, MOST_STEPS = 1000, 10**10
_Name = Annotated[str, MaxLen(100)]
_Length = Annotated[FiniteFloat, Ge(0.0)]


@dataclass(frozen=True)
class Grid:
    """What to train: every algorithm on every environment with every seed."""

    envs: tuple[_Name, ...]
    algos: tuple[_Name, ...]
    seeds: int
    """The number of runs of each pair, with the seeds 0, 1, …"""
    steps: int
    preset_name: _Name = DEFAULT_PRESET
    backend: _Name = DEFAULT_BACKEND
    checkpoint_every: int = 50_000

    def check(self) -> None:
        """Raises GymMaraError if a name is missing, unknown or given twice, or a number is out of range."""
        for env in self.envs:
            if env not in environment_names():
                raise unknown("environment", env, environment_names())
        for algo in self.algos:
            algorithm(algo).presets_of(self.preset_name)
        check_backend(self.backend)
        for kind, names in (("environment", self.envs), ("algorithm", self.algos)):
            if not names:
                raise GymMaraError(f"a grid needs at least one {kind}")
            if len(set(names)) < len(names):
                raise GymMaraError(f"{', '.join(names)}: give each name once")
        for name, most in (
            ("seeds", MOST_SEEDS),
            ("steps", MOST_STEPS),
            ("checkpoint_every", MOST_STEPS),
        ):
            if whole_number(name, value := getattr(self, name)) > most:
                raise GymMaraError(f"{name} must be at most {most:,}, not {short(value)}")

    def runs(self) -> dict[str, RunConfig]:
        """Name → run."""
        return {
            f"{file_name(env)}_{algo}_{seed}": RunConfig(
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


@dataclass(frozen=True)
class _GridFile(Grid):
    """The content of grid.json."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(extra="forbid")
    presets: dict[_Name, tuple[dict[str, Any], ...]] = field(kw_only=True)
    """Algorithm → its presets when the grid was started."""


Metrics = TypedDict(
    "Metrics",
    {
        "position_error_mm": _Length | None,
        "angle_deg": _Length | None,
        "success_percent": _Length | None,
        "reward_per_step": FiniteFloat,
        "return": FiniteFloat,
        "collisions": _Length,
    },
)
"""The means over the episodes of a policy; None for what its task does not measure."""


class Result(TypedDict):
    """The result of a finished run, the content of result.json."""

    episodes: Annotated[int, Ge(1)]
    """How many episodes measured each policy."""
    last: Metrics
    best: Metrics
    steps_to_10_mm: Annotated[int, Ge(0)] | None
    seconds: _Length


def open_grid(folder: Path, grid: Grid) -> None:
    """Make the folder of a grid, or check that an existing folder holds this grid.

    Raises:
        GymMaraError: a value is wrong, or the folder holds another grid or other files.
    """
    grid.check()
    file = folder / "grid.json"
    if os.path.lexists(file):
        existing = _read(folder)
        differences = [
            f"{name} {before!r} there, {now!r} now"
            for name, now in asdict(grid).items()
            if (before := getattr(existing, name)) != now
        ]
        if not differences and asdict(existing)["presets"] != _presets(grid):
            differences = [f"the {grid.preset_name!r} presets have changed since"]
        if differences:
            raise GymMaraError(
                f"{str(folder)!r} holds another grid ({'; '.join(differences)}): choose another --out"
            )
        return
    if folder.exists() and not folder.is_dir():
        raise GymMaraError(f"{str(folder)!r} is a file: choose another --out")
    if folder.exists() and any(not entry.name.startswith(".grid-") for entry in folder.iterdir()):
        raise GymMaraError(f"{str(folder)!r} holds files but no grid: choose another --out")
    with writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
    write_json(file, {**asdict(grid), "presets": _presets(grid)})


def read_grid(folder: Path) -> Grid:
    """The grid in a folder.

    Raises:
        GymMaraError: the folder holds no grid, or grid.json is damaged.
    """
    read = asdict(_read(folder))
    del read["presets"]
    return Grid(**read)


def _presets(grid: Grid) -> dict[str, Any]:
    """A grid's presets as they are now, as JSON values."""
    found = {}
    for algo in grid.algos:
        teleporting, travelling, families = algorithm(algo).presets_of(grid.preset_name)
        each = [teleporting, travelling, *(families[family] for family in sorted(families))]
        found[algo] = tuple(json.loads(json.dumps(asdict(preset))) for preset in each)
    return found


def _read(folder: Path) -> _GridFile:
    """A grid, and the presets that it was started with."""
    try:
        grid = read_json(folder / "grid.json", _GridFile)
    except MissingFileError:
        raise GymMaraError(f"{str(folder)!r} holds no grid: there is no grid.json") from None
    try:
        grid.check()
    except GymMaraError as error:
        raise DamagedFileError(f"cannot read {str(folder / 'grid.json')!r}: {error}") from None
    return grid


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
        if valid_result(folder / name) is None
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

    busy = f"another process is training {str(path)!r}; wait for it"
    with locked(path.with_name(f".{path.name}.lock"), busy, PATIENCE):
        try:
            result = _result(_trained(path, config, on_progress))
        except DamagedRunError as error:
            renamed = _set_aside(path)
            send(f"{error}; renamed to {renamed.name!r} and trained again")
            result = _result(train(config, path, on_progress))
        file = path / "result.json"
        if os.path.lexists(file) and valid_result(path) is None:
            renamed = _set_aside(file)
            send(
                f"{file.name} is damaged, or of an older version; renamed to {renamed.name!r} and written again"
            )
        write_json(file, result)
        distance = result["last"]["position_error_mm"]
        send((config.steps, {} if distance is None else {"eval_position_error_mm": distance}))


def _trained(path: Path, config: RunConfig, on_progress: OnProgress) -> RunFolder:
    """The run, trained to its end."""
    if not path.exists():
        return train(config, path, on_progress)
    if path.is_symlink():
        raise DamagedRunError(f"the run {str(path)!r} is a symbolic link, and is not written to")
    run = RunFolder.open(path)
    if replace(run.config, preset={}) != config:
        raise DamagedRunError(f"the run {str(path)!r} has another configuration than the grid")
    if run.has_policy("last"):
        return run
    return resume(path, on_progress)


def _set_aside(path: Path) -> Path:
    """Rename a damaged run or file; its new path."""
    number = 1
    while os.path.lexists(renamed := path.with_name(f"{path.name}.damaged{number}")):
        number += 1
    with writing(renamed):
        os.replace(path, renamed)
    return renamed


def _result(run: RunFolder) -> Result:
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
    episodes = episodes_to_judge(run.config, RANDOM_EPISODES)
    return {
        "episodes": episodes,
        "last": _metrics(run, "last", episodes),
        "best": _metrics(run, "best", episodes),
        "steps_to_10_mm": int(reached[0]) if reached else None,
        "seconds": float(run.seconds()),
    }


def _metrics(run: RunFolder, which: str, episodes: int) -> Metrics:
    measured = evaluate_run(run, episodes=episodes, which=which)
    means = {name: float(measured[name].mean()) for name in Metrics.__annotations__}
    metrics: Any = {name: value if math.isfinite(value) else None for name, value in means.items()}
    return cast("Metrics", metrics)


def read_result(path: Path) -> Result | None:
    """The result of a run; None if it has not finished.

    Raises:
        DamagedRunError: result.json is damaged; the message says how to write it again.
    """
    try:
        return read_json(path / "result.json", Result)
    except MissingFileError:
        return None
    except DamagedFileError as error:
        raise DamagedRunError(
            f"{error}; give the same benchmark command again to evaluate the run again"
        ) from None


def valid_result(path: Path) -> Result | None:
    """The result of a run; None if it has not finished or result.json is damaged."""
    try:
        return read_result(path)
    except DamagedRunError:
        return None
