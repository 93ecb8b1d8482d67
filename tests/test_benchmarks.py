"""The benchmark for a GPU runs on the CPU too, where its figures mean nothing, and says where there is no GPU; the soak finds faults."""

from __future__ import annotations

import importlib
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from gymnasium.spaces import Box, Dict

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"
SCRIPT = BENCHMARKS / "gpu.py"


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


@pytest.fixture
def soaking(monkeypatch: pytest.MonkeyPatch) -> dict[str, ModuleType]:
    """The parts of the soak by their names."""
    monkeypatch.syspath_prepend(BENCHMARKS)
    names = ("tally", "environments", "written")
    return {name: importlib.import_module(f"soaking.{name}") for name in names}


def test_the_soak_finds_what_is_wrong(soaking: dict[str, ModuleType]) -> None:
    space = Dict({"state": Box(-1.0, 1.0, (2,)), "seen": Dict({"depth": Box(0.0, 9.0, (1,))})})

    def wrong(state: float = 0.0, depth: float = 1.0, reward: float = 0.0) -> dict[str, int]:
        tally = soaking["tally"].Tally()
        parts = {"state": np.full(2, state, np.float32)}
        seen = {**parts, "seen": {"depth": np.full(1, depth, np.float32)}}
        tally.observe(space, seen, np.array([reward]))
        tally.compare([np.zeros(2)], [np.full(2, state)])
        assert (tally.done["steps"], tally.done["comparisons"]) == (1, 1)
        return dict(+tally.wrong)

    assert wrong() == {}
    assert wrong(reward=np.nan) == {"NaN": 1}
    assert wrong(depth=np.nan) == {"NaN": 1, "outside the space": 1}
    assert wrong(depth=-1.0) == {"outside the space": 1}
    assert wrong(state=0.5) == {"other result": 1}


def test_scenarios_of_the_soak_find_nothing_wrong(soaking: dict[str, ModuleType]) -> None:
    tally, options = soaking["tally"].Tally(), {"backend": "pinocchio", "pixel_size": 16}
    seen = {"observation": "state+pixels", "pixel_channels": ["depth"], **options}
    soaking["environments"].observed_pictures(0, tally, name="MARAReach-v0", **seen)
    soaking["environments"].single(0, tally, name="MARAGoal-v0", backend="pinocchio")
    soaking["written"].recordings(0, tally, form="lerobot", episodes=1, pixels=None)
    assert +tally.wrong == {}
    assert tally.done["comparisons"] == 3
    assert tally.done["pictures"] > 900
    assert tally.done["files"] == 2
