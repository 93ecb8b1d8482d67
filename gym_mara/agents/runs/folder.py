"""A run folder: the files of one training, and how they are written and read.

config.json        the configuration, and the versions of the libraries
progress.csv       a row per update and per evaluation
tensorboard/       the same values for TensorBoard
checkpoints/N/     the policy, and the state to resume from, after N steps
best/, last/       the policy with the best evaluation and the last one
learning_curve.png

A policy's folder holds model.zip, the model in the form of Stable-Baselines3, and policy.json, which says how it is used.
"""

from __future__ import annotations

import csv
import io
import platform
import re
import shutil
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from gym_mara.agents.runs.config import DamagedRunError, RunConfig, config_values, read_config
from gym_mara.errors import GymMaraError, unknown
from gym_mara.files import DamagedFileError, read_text, write_json

__all__ = [
    "POLICIES",
    "DamagedRunError",
    "RunConfig",
    "RunFolder",
    "read_progress",
    "versions",
]

POLICIES = ("last", "best")
_LIBRARIES = ("gym_mara", "gymnasium", "numpy", "pin", "stable_baselines3", "sb3_contrib", "torch")
_ENGINES = ("coal", "dartpy", "python-fcl")  # recorded if installed
_LARGEST_TABLE = 2**29
_MOST_CELLS = 2 * 10**7
_LARGEST_WHOLE = 10**15


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
            raise GymMaraError(
                f"cannot make the run folder {str(path)!r}: {error.strerror}"
            ) from error
        try:
            write_json(path / "config.json", config_values(config, versions()))
        except GymMaraError:
            shutil.rmtree(path, ignore_errors=True)
            raise
        return cls(path, config)

    @classmethod
    def open(cls, path: Path) -> RunFolder:
        """The run in an existing folder.

        Raises:
            DamagedRunError: the folder holds no run, or its configuration is damaged.
        """
        file = path / "config.json"
        if not file.is_file():
            raise DamagedRunError(
                f"{str(path)!r} is not a run folder, such as runs/first: it has no config.json"
            )
        try:
            config = read_config(file)
            config.made_preset()
        except DamagedFileError as error:
            raise DamagedRunError(f"the run folder {str(path)!r} is damaged: {error}") from error
        return cls(path, config)

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
        with suppress(OSError):
            found = [p for p in (self.path / "checkpoints").iterdir() if _NUMBER.fullmatch(p.name)]
            return sorted(found, key=lambda p: int(p.name))
        return []

    def trained_steps(self) -> int:
        """The steps trained up to the last checkpoint; more than asked for, because an update is made of many steps."""
        checkpoints = self.checkpoints()
        return int(checkpoints[-1].name) if checkpoints else 0

    def policy_steps(self, which: str) -> int:
        """The steps that the policy "last" or "best" was trained; the best one is that of the first evaluation with the highest reward.

        Raises:
            DamagedRunError: the table of progress is missing, damaged or without evaluations.
        """
        if which == "last":
            return self.trained_steps()
        column = "eval/reward_per_step"
        evaluated = [row for row in read_progress(self.progress_file) if column in row]
        if not evaluated:
            raise DamagedRunError(f"the table {str(self.progress_file)!r} has no evaluations")
        return int(max(evaluated, key=lambda row: row[column])[_STEPS])

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
                + (", or give --policy best" if which == "last" and self.has_policy("best") else "")
            )
        return folder


def versions() -> dict[str, str]:
    """The versions of Python and of the libraries on which a training depends."""
    found = {library: version(library) for library in _LIBRARIES}
    for library in _ENGINES:
        with suppress(PackageNotFoundError):
            found[library] = version(library)
    return {**found, "python": platform.python_version()}


def read_progress(file: Path) -> list[dict[str, float]]:
    """The rows of a table of progress, without their empty cells.

    Raises:
        DamagedRunError: the file is missing, or not such a table.
    """
    try:
        text = read_text(file, _LARGEST_TABLE)
        text = text[: text.rfind("\n") + 1]  # a full disk may have cut the last row
        numbers, cells = [], 0
        for row in csv.DictReader(io.StringIO(text, newline="")):
            if None in row:
                raise ValueError("a row has more cells than the table has columns")
            if not row.get(_STEPS):
                continue
            cells += len(row)
            if cells > _MOST_CELLS:
                raise ValueError(f"it has more than {_MOST_CELLS:,} cells")
            numbers.append({k: _number(v) for k, v in row.items() if k and v})
            if not 0 <= numbers[-1][_STEPS] <= _LARGEST_WHOLE:
                raise ValueError(f"{_STEPS} is {numbers[-1][_STEPS]}")
        return numbers
    except (csv.Error, ValueError) as error:
        raise DamagedRunError(f"the table {str(file)!r} is damaged: {error}") from error


_STEPS = "time/total_timesteps"
_NUMBER = re.compile("[0-9]{1,15}")


def _number(text: str) -> float:
    return int(text) if _NUMBER.fullmatch(text) else float(text)
