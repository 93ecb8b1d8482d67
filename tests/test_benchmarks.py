"""The benchmark for a GPU runs on the CPU too, where its figures mean nothing, and says where there is no GPU."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "gpu.py"


def _done(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *arguments]
    return subprocess.run(command, check=False, capture_output=True, text=True, timeout=600)


@pytest.mark.nightly
def test_every_measurement_is_made_and_written_though_others_fail(tmp_path: Path) -> None:
    file = tmp_path / "gpu.md"
    small = ["--device", "cpu", "--arms", "0", "2", "2", "--training-arms", "2", "--seconds", "0.1"]
    done = _done(*small, "--out", str(file))
    assert done.returncode == 0, done.stderr
    assert file.read_text() == done.stdout
    rows = [line.split(" | ") for line in done.stdout.splitlines() if line.startswith("| ")]
    measured = {(row[0].removeprefix("| "), row[1], row[2]) for row in rows}
    assert ("dynamics", "0", "failed") in measured
    for name in ("dynamics", "dynamics in contact", "kinematics", "travelling", "training"):
        assert (name, "2", "steps/s") in measured, done.stderr
    assert ("dynamics", "2", "relative to the bare graph") in measured


@pytest.mark.slow
def test_without_a_gpu_it_says_so() -> None:
    torch = pytest.importorskip("torch")
    if torch.cuda.is_available():
        pytest.skip("there is a GPU")
    done = _done()
    assert done.returncode == 1
    assert "finds no GPU" in done.stderr
    assert len(done.stderr.splitlines()) == 1
