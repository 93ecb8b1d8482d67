"""The one door for files: reading is bounded and checked, writing is whole or not at all."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
from annotated_types import Ge

from gym_mara.errors import GymMaraError
from gym_mara.files import (
    DamagedFileError,
    MissingFileError,
    folder_written_aside,
    read_bytes,
    read_json,
    read_text,
    refuse_links,
    write_json,
    write_text,
    written_aside,
)

ROOT = Path(__file__).resolve().parents[1]


@dataclass
class Form:
    name: str
    steps: Annotated[int, Ge(1)]


def test_a_pipe_a_device_and_a_folder_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for file in (tmp_path / "pipe", Path("/dev/full"), Path("/dev/zero"), tmp_path):
        with pytest.raises(DamagedFileError, match=r"plain file|Is a directory"):
            read_bytes(file, 100)


def test_a_large_file_is_refused_before_it_is_read(tmp_path: Path) -> None:
    file = tmp_path / "large"
    with file.open("wb") as stream:
        stream.truncate(2**40)  # sparse
    with pytest.raises(DamagedFileError, match="larger than 16,777,216 bytes"):
        read_text(file)


def test_a_missing_file_and_a_bad_path_have_clear_errors(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no such file"):
        read_text(tmp_path / "none")
    with pytest.raises(DamagedFileError, match="null"):
        read_text(Path("a\0b"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "JSON"),
        ("[" * 100_000, "JSON"),
        ('{"name": "a"}', "steps: Field required"),
        ('{"name": 1, "steps": 2}', "name: .*string, not 1"),
        ('{"name": "a", "steps": "2"}', "steps: .*integer, not '2'"),
        ('{"name": "a", "steps": 0}', "steps: .*greater than or equal to 1, not 0"),
        ('{"name": "a", "steps": true}', "steps: .*integer"),
        ('{"name": "a", "steps": -1' + 5000 * "0" + "}", "."),
        ("\xff", "JSON|expected"),
    ],
)
def test_json_of_another_form_is_refused_with_the_value(
    tmp_path: Path, text: str, message: str
) -> None:
    file = tmp_path / "file.json"
    file.write_bytes(text.encode("latin-1"))
    with pytest.raises(DamagedFileError, match=f"file.json.*{message}"):
        read_json(file, Form)


def test_what_was_written_is_read(tmp_path: Path) -> None:
    file = tmp_path / "file.json"
    write_json(file, {"name": "é", "steps": 3})
    assert read_json(file, Form) == Form("é", 3)
    assert list(tmp_path.iterdir()) == [file]


def test_files_are_in_utf_8_whatever_the_locale(tmp_path: Path) -> None:
    code = """
from pathlib import Path
from gym_mara.files import read_text, write_text
write_text(Path("file"), "\\xb1\\u03c0")
assert read_text(Path("file")) == "\\xb1\\u03c0"
"""
    ascii_only = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={"PYTHONPATH": str(ROOT), **os.environ, **ascii_only},
        check=True,
    )
    assert (tmp_path / "file").read_bytes() == "±π".encode()


def test_a_new_file_replaces_no_other(tmp_path: Path) -> None:
    file = tmp_path / "file"
    write_text(file, "old", new=True)
    with pytest.raises(GymMaraError, match="not overwritten"):
        write_text(file, "new", new=True)
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_new_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "file"

    def write_while_another_does() -> None:
        with written_aside(file, new=True) as aside:
            aside.write_text("mine")
            file.write_text("theirs")

    with pytest.raises(GymMaraError, match="not overwritten"):
        write_while_another_does()
    assert file.read_text() == "theirs"
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_size_limit_leaves_the_old_file(tmp_path: Path, small_files: None) -> None:
    file = tmp_path / "file"
    write_text(file, "old")
    with pytest.raises(GymMaraError, match=r"cannot write .*file.*: File too large"):
        write_text(file, 2000 * "x")
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_an_interrupt_leaves_the_old_file(tmp_path: Path) -> None:
    file = tmp_path / "file"
    write_text(file, "old")

    def interrupted() -> None:
        with written_aside(file) as aside:
            aside.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert file.read_text() == "old"
    assert list(tmp_path.iterdir()) == [file]


def test_a_folder_is_written_whole_or_not_at_all(tmp_path: Path) -> None:
    with folder_written_aside(tmp_path / "new") as aside:
        (aside / "file").write_text("whole")
        assert not (tmp_path / "new").exists()
    assert (tmp_path / "new" / "file").read_text() == "whole"

    def interrupted() -> None:
        with folder_written_aside(tmp_path / "other") as aside:
            (aside / "file").write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with pytest.raises(GymMaraError, match="not overwritten"), folder_written_aside(tmp_path):
        pass
    with (
        pytest.raises(GymMaraError, match="make it first"),
        folder_written_aside(tmp_path / "none" / "new"),
    ):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["new"]


def test_a_device_or_a_missing_folder_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(GymMaraError, match="not a plain file"):
        write_text(Path("/dev/full"), "x")
    with pytest.raises(GymMaraError, match=r"no folder .*make it first"):
        write_text(tmp_path / "none" / "file", "x")


def test_a_folder_with_a_link_at_any_depth_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "file").touch()
    refuse_links(tmp_path)
    (tmp_path / "a" / "b" / "link").symlink_to("/nowhere")
    with pytest.raises(DamagedFileError, match="symbolic link"):
        refuse_links(tmp_path)


def test_no_other_module_reads_or_writes_a_text_file_itself() -> None:
    found = []
    for module in sorted((ROOT / "gym_mara").rglob("*.py")):
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or module.name == "files.py":
                continue
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            by_path = isinstance(node.func, ast.Attribute) and name in ("read_text", "write_text")
            if by_path or (isinstance(node.func, ast.Name) and name == "open"):
                found.append(f"{module.name}: {ast.unparse(node)}")
    assert not found, "use gym_mara.files: whole or not at all, in UTF-8, and bounded"
