"""A run folder: the files of one training, and how they are written and read.

config.json        the configuration, and the versions of the libraries
progress.csv       a row per update and per evaluation
tensorboard/       the same values for TensorBoard
checkpoints/N/     the policy, its normalisation and the state to resume from, after N steps
best/, last/       the policy with the best evaluation and the last one, each with its normalisation
learning_curve.png
"""

from __future__ import annotations

import csv
import json
import os
import platform
import shutil
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar, get_origin, get_type_hints

from gym_mara.agents.algorithms.base import Preset
from gym_mara.agents.algorithms.registry import DEFAULT_PRESET
from gym_mara.errors import GymMaraError, unknown

POLICIES = ("last", "best")
_LIBRARIES = ("gym_mara", "gymnasium", "numpy", "pin", "stable_baselines3", "sb3_contrib", "torch")
_ENGINES = ("coal", "dartpy", "python-fcl")  # recorded if installed
_Dataclass = TypeVar("_Dataclass")


class DamagedRunError(GymMaraError):
    """A file of a run is missing or cannot be read."""


@dataclass(frozen=True)
class RunConfig:
    """What a run trains. The same configuration with the same versions of the libraries gives the same run."""

    env: str
    algo: str
    backend: str
    steps: int
    seed: int
    checkpoint_every: int = 50_000
    """Steps between two checkpoints; each checkpoint is evaluated."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the environment, without `backend`."""
    preset_name: str = DEFAULT_PRESET
    preset: dict[str, Any] = field(default_factory=dict)
    """The values of the preset, so that a later change of the preset does not change the run."""


class RunFolder:
    """The folder of one run."""

    def __init__(self, path: Path, config: RunConfig) -> None:
        self.path = path
        self.config = config

    @classmethod
    def create(cls, path: Path, config: RunConfig) -> RunFolder:
        """Make the folder of a new run.

        Raises:
            GymMaraError: the folder exists already, or cannot be made.
        """
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            hint = (
                f", or resume the run with --resume {path}"
                if (path / "config.json").is_file()
                else ""
            )
            raise GymMaraError(
                f"{str(path)!r} exists and is not overwritten: choose another --out{hint}"
            ) from None
        except OSError as error:
            raise GymMaraError(f"cannot make the run folder {str(path)!r}: {error}") from error
        run = cls(path, config)
        versions = {library: version(library) for library in _LIBRARIES}
        for library in _ENGINES:
            with suppress(PackageNotFoundError):
                versions[library] = version(library)
        versions["python"] = platform.python_version()
        text = json.dumps({**asdict(config), "versions": versions}, indent=2) + "\n"
        write_atomically(path / "config.json", text)
        return run

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """The run in an existing folder.

        Raises:
            DamagedRunError: the folder holds no run, or its configuration is damaged.
        """
        file = path / "config.json"
        if not file.is_file():
            raise DamagedRunError(f"{str(path)!r} is not a run folder: it has no config.json")
        try:
            values = dict(json.loads(file.read_text()))
            values.pop("versions")
            config = _as(RunConfig, values)
            _as(Preset, config.preset)
            return cls(path, config)
        except (ValueError, KeyError, TypeError) as error:
            raise DamagedRunError(
                f"the run folder {str(path)!r} is damaged: cannot read config.json ({error})"
            ) from error

    @property
    def progress_file(self) -> Path:
        """The table of progress."""
        return self.path / "progress.csv"

    def seconds(self) -> float:
        """The training time up to the last checkpoint, s."""
        column = "time/time_elapsed"
        return max((r[column] for r in read_progress(self.progress_file) if column in r), default=0)

    def checkpoints(self) -> list[Path]:
        """The folders of the complete checkpoints, the oldest first."""
        folder = self.path / "checkpoints"
        found = [p for p in folder.glob("*") if p.name.isdigit()] if folder.is_dir() else []
        return sorted(found, key=lambda p: int(p.name))

    def has_policy(self, which: str) -> bool:
        """Whether the run has a policy "last" or "best"."""
        return (self.path / which / "model.zip").is_file()

    def policy(self, which: str) -> Path:
        """The folder of the policy "last" or "best".

        Raises:
            GymMaraError: the run has no such policy yet.
        """
        folder = self.path / which
        if which not in POLICIES:
            raise unknown("policy", which, POLICIES)
        if not self.has_policy(which):
            raise GymMaraError(
                f"the run {str(self.path)!r} has no {which!r} policy: it has not finished; resume it with --resume"
            )
        return folder


def _as(cls: type[_Dataclass], values: dict[str, Any]) -> _Dataclass:
    """A dataclass made of values from a file.

    Raises:
        TypeError: a field is missing, unknown, or of another type.
    """
    made = cls(**values)
    for name, hint in get_type_hints(cls).items():
        if type(value := getattr(made, name)) is not (get_origin(hint) or hint):
            raise TypeError(f"{name} is {value!r}")
    return made


def write_atomically(file: Path, text: str) -> None:
    """Write a file so that at any time, even after a kill, it holds either the old text or the new one."""
    temporary = file.with_name(f".{file.name}.tmp")
    with temporary.open("w") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(temporary, file)


def replace_folder(new: Path, target: Path) -> None:
    """Replace a folder by a new one; after a kill at any time at least one of the two exists."""
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        os.replace(target, old)
    os.replace(new, target)
    shutil.rmtree(old, ignore_errors=True)


def read_progress(file: Path) -> list[dict[str, float]]:
    """The rows of a table of progress, without their empty cells.

    Raises:
        DamagedRunError: the file is not such a table.
    """
    try:
        with file.open(newline="") as stream:
            rows = list(csv.DictReader(stream))
        complete = [row for row in rows if row.get("time/total_timesteps")]
        return [{k: _number(v) for k, v in row.items() if k and v} for row in complete]
    except (csv.Error, ValueError) as error:
        raise DamagedRunError(f"the table {str(file)!r} is damaged: {error}") from error


def _number(text: str) -> float:
    return int(text) if text.isdigit() else float(text)
