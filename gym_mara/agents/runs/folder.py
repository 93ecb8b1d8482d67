"""A run folder: everything that one training leaves behind, and how to read it again.

config.json        what was asked for, the versions of the libraries
progress.csv       a row per update
tensorboard/       the same for TensorBoard
checkpoints/N/     the policy, its normalisation and the state to go on from, after N steps
best/, last/       the policy that did best in evaluation, and the last one, each with its normalisation
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
_ENGINES = ("coal", "dartpy", "python-fcl")  # where they are installed
_Form = TypeVar("_Form")


class DamagedRunError(GymMaraError):
    """What a run has left cannot be read."""


@dataclass(frozen=True)
class RunConfig:
    """What a run trains; together with the versions it repeats the run."""

    env: str
    algo: str
    backend: str
    steps: int
    seed: int
    checkpoint_every: int = 50_000
    """How many steps lie between two checkpoints; each is evaluated."""
    env_options: dict[str, Any] = field(default_factory=dict)
    """Keyword arguments of the environment besides `backend`."""
    preset_name: str = DEFAULT_PRESET
    preset: dict[str, Any] = field(default_factory=dict)
    """The preset as it was, so that a later change of it does not change the run."""


class RunFolder:
    """The folder of one run."""

    def __init__(self, path: Path, config: RunConfig) -> None:
        self.path = path
        self.config = config

    @classmethod
    def create(cls, path: Path, config: RunConfig) -> RunFolder:
        """Begin a run in a new folder.

        Raises:
            GymMaraError: the folder exists; nothing is overwritten.
        """
        try:
            path.mkdir(parents=True)
        except FileExistsError:
            hint = f", or go on with --resume {path}" if (path / "config.json").is_file() else ""
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
            GymMaraError: it is no run folder, or its configuration is damaged.
        """
        file = path / "config.json"
        if not file.is_file():
            raise DamagedRunError(f"{str(path)!r} is no run folder: it has no config.json")
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
        """The table of progress, a row per update."""
        return self.path / "progress.csv"

    def seconds(self) -> float:
        """How long the run has trained, up to its last checkpoint, s."""
        column = "time/time_elapsed"
        return max((r[column] for r in read_progress(self.progress_file) if column in r), default=0)

    def checkpoints(self) -> list[Path]:
        """The folders of the complete checkpoints, the oldest first."""
        folder = self.path / "checkpoints"
        found = [p for p in folder.glob("*") if p.name.isdigit()] if folder.is_dir() else []
        return sorted(found, key=lambda p: int(p.name))

    def has_policy(self, which: str) -> bool:
        """Whether the run has left the policy "last" or "best"."""
        return (self.path / which / "model.zip").is_file()

    def policy(self, which: str) -> Path:
        """The folder of the policy "last" or "best".

        Raises:
            GymMaraError: the run has none yet.
        """
        folder = self.path / which
        if which not in POLICIES:
            raise unknown("policy", which, POLICIES)
        if not self.has_policy(which):
            raise GymMaraError(
                f"the run {str(self.path)!r} has no {which!r} policy: it has not finished; go on with --resume"
            )
        return folder


def _as(form: type[_Form], values: dict[str, Any]) -> _Form:
    """A dataclass with values that came from a file.

    Raises:
        TypeError: a field is missing, unknown, or of another type.
    """
    made = form(**values)
    for name, hint in get_type_hints(form).items():
        if type(value := getattr(made, name)) is not (get_origin(hint) or hint):
            raise TypeError(f"{name} is {value!r}")
    return made


def write_atomically(file: Path, text: str) -> None:
    """Write a file so that a reader, or a kill, finds the old or the new one, never a half."""
    temporary = file.with_name(f".{file.name}.tmp")
    with temporary.open("w") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())
    os.replace(temporary, file)


def replace_folder(new: Path, target: Path) -> None:
    """Put a finished folder in the place of another; a kill leaves one of the two in reach."""
    old = target.with_name(f".{target.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        os.replace(target, old)
    os.replace(new, target)
    shutil.rmtree(old, ignore_errors=True)


def read_progress(file: Path) -> list[dict[str, float]]:
    """The rows of a table of progress; a cell that is empty is left out of its row.

    Raises:
        DamagedRunError: it is no such table.
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
