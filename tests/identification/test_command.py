"""The command gym-mara identify refuses what cannot work before it reads a bag."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.helpers import Cli


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("robot=ur5", "unknown keyword argument 'robot' of the backend 'dart'. Valid: .* --robot"),
        ("log=1", "unknown keyword argument 'log' of the backend 'dart'"),
        ("parameters=1", "unknown keyword argument 'parameters' of the backend 'dart'"),
        ("guide=true", "unknown keyword argument 'guide' of the backend 'dart'"),
    ],
)
def test_only_settings_of_the_backend_are_taken(
    tmp_path: Path, gym_mara: Cli, setting: str, message: str
) -> None:
    code, _, error = gym_mara("identify", tmp_path / "bag", "--set", setting)
    assert code == 2
    assert re.search(message, error)
    assert "Traceback" not in error


def test_a_file_that_cannot_be_written_is_refused_first(tmp_path: Path, gym_mara: Cli) -> None:
    (tmp_path / "old.json").write_text("mine")
    for name, message in (("no/x.json", "there is no folder"), ("old.json", "is not overwritten")):
        code, _, error = gym_mara("identify", tmp_path / "bag", "--out", tmp_path / name)
        assert code == 2
        assert message in error
    assert [entry.name for entry in tmp_path.iterdir()] == ["old.json"]
