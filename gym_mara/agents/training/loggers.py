"""Where a training logs its values: the table of the run, always; TensorBoard; Weights & Biases."""

from __future__ import annotations

import os
import re
import secrets
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from stable_baselines3.common.logger import CSVOutputFormat, KVWriter, TensorBoardOutputFormat
from torch.utils.tensorboard import SummaryWriter

from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.agents.training import LOGGERS
from gym_mara.errors import GymMaraError, one_of
from gym_mara.extras import needs
from gym_mara.files import DamagedFileError, MissingFileError, read_text, write_text


def check_loggers(names: Sequence[str]) -> None:
    """Check that these loggers can be used.

    Raises:
        GymMaraError: a name is none of LOGGERS.
        MissingExtraError: the library of a logger is not installed.
    """
    for name in names:
        one_of("logger", name, LOGGERS)
    if "wandb" in names:
        _wandb()


def make_writers(run: RunFolder, steps: int, names: Sequence[str]) -> list[KVWriter]:
    """The writers of a training that has reached a number of steps.

    A resumed run drops what it wrote after its last checkpoint, except in Weights & Biases, which does not take it twice.

    Args:
        run: the run, whose table is always written: a resumed run and the learning curve need it.
        steps: what the training has reached.
        names: the loggers, from LOGGERS.

    Raises:
        GymMaraError: the table is not a plain file, or a library refuses.
    """
    writers: list[KVWriter] = [_table(run, steps)]
    try:
        if "tensorboard" in names:
            writers.append(_tensorboard(run, steps))
        if "wandb" in names:
            writers.append(WandbWriter(run))
    except BaseException:
        for writer in writers:
            writer.close()
        raise
    return writers


def _table(run: RunFolder, steps: int) -> CSVOutputFormat:
    kept = run.path / "progress.csv.kept"  # the old table, until its rows are in the new one
    if os.path.lexists(run.progress_file) and not run.progress_file.is_file():
        raise GymMaraError(f"cannot write {str(run.progress_file)!r}: it is not a plain file")
    if run.progress_file.is_file() and not kept.is_file():
        os.replace(run.progress_file, kept)
    rows = read_progress(kept) if kept.is_file() else []
    table = CSVOutputFormat(str(run.progress_file))
    try:
        for row in rows:
            if row["time/total_timesteps"] <= steps:
                table.write(dict(row), {})
    except BaseException:
        table.close()
        raise
    kept.unlink(missing_ok=True)
    return table


def _tensorboard(run: RunFolder, steps: int) -> TensorBoardOutputFormat:
    folder = str(run.path / "tensorboard")
    if steps == 0:
        shutil.rmtree(folder, ignore_errors=True)
    tensorboard = TensorBoardOutputFormat(folder)
    if steps and tensorboard.writer is not None:
        tensorboard.writer.close()  # type: ignore[no-untyped-call]
        tensorboard.writer = SummaryWriter(folder, purge_step=steps + 1)  # type: ignore[no-untyped-call]
    return tensorboard


class WandbWriter(KVWriter):
    """Logs a run to Weights & Biases, as one run there; a resumed training goes on with it.

    The library's own settings choose project, account and mode, such as the environment variables WANDB_PROJECT and
    WANDB_MODE=offline. Its files are not in the run folder.

    Args:
        run: the run.

    Raises:
        GymMaraError: the library refuses to begin a run, or wandb.id in the run folder is damaged.
        MissingExtraError: it is not installed.
    """

    def __init__(self, run: RunFolder) -> None:
        wandb = _wandb()
        name = run.path.absolute().name
        identity = _identity(run.path / "wandb.id")
        try:
            self._run = wandb.init(
                project=os.environ.get("WANDB_PROJECT", "gym_mara"),
                name=name,
                id=identity,
                resume="allow",
                config=asdict(run.config),
            )
        except Exception as error:  # the library has many, which differ between its versions
            raise GymMaraError(
                f"Weights & Biases refuses to begin a run: {error}; log in with `wandb login`, set WANDB_MODE=offline, or leave "
                "wandb out of --log"
            ) from error

    def write(
        self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0
    ) -> None:
        """Log the numbers of one step; see Stable-Baselines3."""
        values = {k: float(v) for k, v in key_values.items() if not isinstance(v, str)}
        self._run.log(values, step=step)

    def close(self) -> None:
        """Finish the run there."""
        self._run.finish()


def _identity(file: Path) -> str:
    """The id of a run there: random, and kept in a file of the run folder, so that no other run has it."""
    try:
        identity = read_text(file, 100).strip()
    except MissingFileError:
        identity = secrets.token_hex(8)
        write_text(file, f"{identity}\n", new=True)
    if not re.fullmatch(r"[0-9a-f]{16}", identity):
        raise DamagedFileError(
            f"{str(file)!r} is damaged: it must be 16 hexadecimal digits; delete it to begin a new run there"
        )
    return identity


def _wandb() -> Any:
    with needs("logging to Weights & Biases", "wandb"):
        import wandb
    return wandb
