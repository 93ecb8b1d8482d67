"""The weights in a model.zip: only finite numbers are read, quickly and in little memory."""

from __future__ import annotations

import io
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gym_mara.agents.runs.archive import LARGEST, read_weights
from gym_mara.files import DamagedFileError

WEIGHTS = {"layer.weight": torch.arange(6.0).reshape(2, 3), "layer.bias": torch.zeros(2)}


def saved(value: Any) -> bytes:
    """What torch writes."""
    stream = io.BytesIO()
    torch.save(value, stream)
    return stream.getvalue()


def archive(path: Path, members: dict[str, bytes], compression: int = zipfile.ZIP_STORED) -> Path:
    """A zip archive with these members."""
    file = path / "model.zip"
    with zipfile.ZipFile(file, "w", compression) as stream:
        for name, content in members.items():
            stream.writestr(name, content)
    return file


def test_weights_come_back(tmp_path: Path) -> None:
    read = read_weights(archive(tmp_path, {"policy.pth": saved(WEIGHTS)}))
    assert read.keys() == WEIGHTS.keys()
    assert all(torch.equal(read[name], WEIGHTS[name]) for name in WEIGHTS)


class Evil:
    """It makes a large array when it is unpickled; torch allows this function."""

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[int]]:
        return bytearray, (10**9,)


@pytest.mark.parametrize(
    "value",
    [
        {"a": torch.tensor([1.0, float("nan")])},
        {"a": torch.tensor([float("inf")])},
        {"a": Evil()},
        {"a": torch.nn.Linear(1, 1)},
        {"a": np.zeros(1)},
        {"a": 1},
        {1: torch.zeros(1)},
        [torch.zeros(1)],
        {"a": torch.zeros(1, dtype=torch.int64)},
    ],
)
def test_anything_but_finite_numbers_is_refused(tmp_path: Path, value: Any) -> None:
    with pytest.raises(DamagedFileError, match=r"more than weights|not finite"):
        read_weights(archive(tmp_path, {"policy.pth": saved(value)}))


class Trap:
    """A failure of the test if it is unpickled."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return pytest.fail, ("it was unpickled",)


@pytest.mark.parametrize("value", [Trap(), {"a": Trap()}, {"a": torch.zeros(1), "b": [Trap()]}])
def test_no_code_runs_in_the_file_of_the_weights(tmp_path: Path, value: Any) -> None:
    with pytest.raises(DamagedFileError, match="more than weights"):
        read_weights(archive(tmp_path, {"policy.pth": saved(value)}))


@pytest.mark.parametrize("inside", [False, True])
def test_a_zip_bomb_is_refused_at_once(tmp_path: Path, inside: bool) -> None:
    bomb = archive(tmp_path, {"policy.pth": bytes(4 * LARGEST)}, zipfile.ZIP_DEFLATED)
    if inside:
        bomb = archive(tmp_path, {"policy.pth": bomb.read_bytes()})
    tracemalloc.start()
    started = time.monotonic()
    with pytest.raises(DamagedFileError, match="holds more than"):
        read_weights(bomb)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert time.monotonic() - started < 1.0
    assert peak < 10 * bomb.stat().st_size + 10**6


def test_a_bomb_that_declares_a_small_size_is_refused(tmp_path: Path) -> None:
    file = archive(tmp_path, {"policy.pth": bytes(2**24)}, zipfile.ZIP_DEFLATED)
    content = file.read_bytes()
    small, large = (size.to_bytes(4, "little") for size in (100, 2**24))
    for before in (
        18,
        20,
    ):  # after the signatures of the local header and of the directory, and the compressed size
        place = content.index(b"PK\x03\x04" if before == 18 else b"PK\x01\x02") + before + 4
        assert content[place : place + 4] == large
        content = content[:place] + small + content[place + 4 :]
    file.write_bytes(content)
    with pytest.raises(DamagedFileError):
        read_weights(file)


def test_too_many_members_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DamagedFileError, match="holds more than"):
        read_weights(archive(tmp_path, {f"{n}": b"" for n in range(1001)}))


@pytest.mark.parametrize("content", [b"", b"text", bytes(100)])
def test_a_file_that_is_no_archive_is_an_error(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "model.zip").write_bytes(content)
    with pytest.raises(DamagedFileError, match="cannot read"):
        read_weights(tmp_path / "model.zip")


def test_an_archive_without_weights_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DamagedFileError, match=r"no policy.pth"):
        read_weights(archive(tmp_path, {"data": b"{}"}))


def test_a_tensor_that_repeats_few_numbers_is_refused_in_little_memory(tmp_path: Path) -> None:
    weights = {"bomb": torch.zeros(1).expand(200_000, 200_000)}
    with pytest.raises(DamagedFileError, match="more than"):
        read_weights(archive(tmp_path, {"policy.pth": saved(weights)}))
