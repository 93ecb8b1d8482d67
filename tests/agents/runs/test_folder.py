"""The folder of a run: its table, its checkpoints, and how it is made."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gym_mara import files
from gym_mara.agents.runs.folder import DamagedRunError, RunFolder, read_progress
from gym_mara.errors import GymMaraError
from tests.agents.conftest import ROLLOUT, config

STEPS = "time/total_timesteps"


def test_a_table_without_its_empty_cells(tmp_path: Path) -> None:
    table = tmp_path / "progress.csv"
    table.write_text(f"{STEPS},a,b\n512,1.5,\n1024,,nan\n,2,3\n")
    first, second = read_progress(table)
    assert first == {STEPS: 512, "a": 1.5}
    assert second.keys() == {STEPS, "b"}


def test_a_row_that_a_full_disk_has_cut_is_left_out(tmp_path: Path) -> None:
    table = tmp_path / "progress.csv"
    table.write_text(f"a,{STEPS}\n1.5,512\n2.5,10")
    assert [row[STEPS] for row in read_progress(table)] == [512]


@pytest.mark.parametrize(
    "rows",
    ["1,x\n", "1,nan\n", "1,-5\n", "1,512,3\n", f"1,{10**30}\n", "x,512\n", "1,\u00b2\n"],
)
def test_a_damaged_table_is_an_error(tmp_path: Path, rows: str) -> None:
    table = tmp_path / "progress.csv"
    table.write_text(f"a,{STEPS}\n" + rows)
    with pytest.raises(DamagedRunError, match="damaged"):
        read_progress(table)


def test_a_table_that_is_no_plain_file_is_an_error(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe", tmp_path / "missing"):
        with pytest.raises(DamagedRunError, match="damaged"):
            read_progress(path)


def test_checkpoints_are_sorted_by_number_and_nothing_else_is_one(tmp_path: Path) -> None:
    run = RunFolder(tmp_path, config())
    assert run.checkpoints() == []
    assert run.trained_steps() == 0
    for name in ("1024", "512", ".512.tmp", "\u00b2", "1e3", "9" * 500):
        try:
            (tmp_path / "checkpoints" / name).mkdir(parents=True)
        except OSError:
            assert len(name) > 255
    assert [path.name for path in run.checkpoints()] == ["512", "1024"]
    assert run.trained_steps() == 1024


def test_more_steps_are_trained_than_asked_for(finished_run: RunFolder) -> None:
    assert finished_run.trained_steps() == 3 * ROLLOUT


def test_a_full_disk_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files, "_to_disk", full)
    with pytest.raises(GymMaraError, match=r"cannot write .*config.json.*No space left"):
        RunFolder.create(tmp_path / "run", config())
    assert not (tmp_path / "run").exists()


def test_a_table_with_too_many_cells_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gym_mara.agents.runs.folder._MOST_CELLS", 5)
    table = tmp_path / "progress.csv"
    table.write_text("time/total_timesteps,a\n" + "1,2\n" * 2)
    assert len(read_progress(table)) == 2
    table.write_text("time/total_timesteps,a\n" + "1,2\n" * 3)
    with pytest.raises(DamagedRunError, match="more than 5 cells"):
        read_progress(table)
