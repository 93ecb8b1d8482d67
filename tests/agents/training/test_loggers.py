"""The loggers of a training: its table is always there, the others are chosen."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gym_mara.agents.runs.folder import RunFolder, read_progress
from gym_mara.agents.training import loggers
from gym_mara.agents.training.train import resume, train
from gym_mara.errors import GymMaraError, MissingExtraError
from tests.agents.conftest import ROLLOUT, config, shorten_episodes, silent
from tests.helpers import Cli


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    shorten_episodes(monkeypatch, 5)


class Wandb:
    """Stands in for the library Weights & Biases."""

    def __init__(self) -> None:
        self.begun: list[dict[str, Any]] = []
        self.logged: list[tuple[int, dict[str, float]]] = []
        self.finished = 0

    def init(self, **arguments: Any) -> Any:
        self.begun.append(arguments)
        return SimpleNamespace(log=self._log, finish=self._finish)

    def _log(self, values: dict[str, float], step: int) -> None:
        self.logged.append((step, values))

    def _finish(self) -> None:
        self.finished += 1


@pytest.fixture
def wandb(monkeypatch: pytest.MonkeyPatch) -> Wandb:
    stand_in = Wandb()
    monkeypatch.setattr(loggers, "_wandb", lambda: stand_in)
    return stand_in


def test_without_tensorboard_there_is_the_table_alone(tmp_path: Path) -> None:
    run = train(config(steps=ROLLOUT), tmp_path / "run", silent, log=["csv"])
    assert read_progress(run.progress_file)
    assert not (run.path / "tensorboard").exists()


def test_weights_and_biases_gets_the_rows_of_the_table_and_goes_on_when_resumed(
    tmp_path: Path, wandb: Wandb
) -> None:
    def stop(steps: int, shown: dict[str, float]) -> None:
        if steps > ROLLOUT:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(config(steps=2 * ROLLOUT), tmp_path / "run", stop, log=["wandb"])
    assert wandb.finished == 1, "also after an interrupt"
    wandb.logged.clear()
    run = resume(tmp_path / "run", silent, log=["wandb"])
    first, second = wandb.begun
    assert first["id"] == second["id"]
    assert first["resume"] == "allow"
    assert first["config"]["algo"] == "ppo"
    rows = [r for r in read_progress(run.progress_file) if r["time/total_timesteps"] > ROLLOUT]
    assert [step for step, _ in wandb.logged][-len(rows) :] == [2 * ROLLOUT] * len(rows)
    assert wandb.logged[-1][1]["eval/reward_per_step"] == pytest.approx(
        rows[-1]["eval/reward_per_step"]
    )


def test_each_run_has_its_own_id_in_weights_and_biases_wherever_its_folder_is(
    tmp_path: Path, wandb: Wandb
) -> None:
    for folder in ("first", "second"):
        (tmp_path / folder).mkdir()
        loggers.WandbWriter(RunFolder(tmp_path / folder, config()))
    shutil.move(tmp_path / "first", tmp_path / "moved")
    loggers.WandbWriter(RunFolder(tmp_path / "moved", config()))
    (tmp_path / "first").mkdir()  # a new run in the place of one that was deleted
    loggers.WandbWriter(RunFolder(tmp_path / "first", config()))
    first, second, moved, again = (begun["id"] for begun in wandb.begun)
    assert moved == first
    assert len({first, second, again}) == 3
    (tmp_path / "first" / "wandb.id").write_text("../other")
    with pytest.raises(GymMaraError, match=r"wandb\.id' is damaged"):
        loggers.WandbWriter(RunFolder(tmp_path / "first", config()))


def test_a_refusal_of_weights_and_biases_is_an_error_in_plain_words(
    tmp_path: Path, wandb: Wandb, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(**_: Any) -> None:
        raise RuntimeError("no API key")

    monkeypatch.setattr(wandb, "init", refuse)
    with pytest.raises(GymMaraError, match=r"no API key.*WANDB_MODE=offline"):
        train(config(steps=ROLLOUT), tmp_path / "run", silent, log=["wandb"])


def test_a_missing_library_is_an_error_before_a_folder_is_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "wandb", None)
    with pytest.raises(MissingExtraError, match=r"Weights & Biases needs wandb.*gym_mara\[wandb\]"):
        train(config(), tmp_path / "run", silent, log=["wandb"])
    assert not (tmp_path / "run").exists()


def test_the_command_takes_the_loggers_from_the_option_or_the_variable(
    tmp_path: Path, gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    short = ("train", "--steps", "1", "--out", tmp_path / "run")
    code, _, error = gym_mara(*short, "--log", "csv,tensorbord")
    assert (code, "Did you mean 'tensorboard'" in error) == (2, True)
    monkeypatch.setenv("MARA_LOG_FORMAT", "stdout,csv")  # as gym-gazebo2's scripts have it
    code, _, error = gym_mara(*short)
    assert (code, "unknown logger 'stdout'" in error) == (2, True)
    monkeypatch.setenv("MARA_LOG_FORMAT", "csv")
    assert gym_mara(*short)[0] == 0
    assert not (tmp_path / "run" / "tensorboard").exists()
