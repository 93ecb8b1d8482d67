"""The examples run, each against the real library, as a user calls them."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"
CALLS = {
    "sb3_ppo.py --way single": "position error",
    "sb3_ppo.py --way in_turn": "position error",
    "sb3_ppo.py --way in_processes": "position error",
    "sb3_ppo.py --way native": "position error",
    "hindsight_replay.py": "return of an episode",
    "cleanrl_ppo.py": "reward per step",
    "cleanrl_ppo.py --env-id gym_mara/MARARandomTarget-v0": "reward per step",
    "skrl_ppo.py": "reward per step",
    "torchrl_ppo.py": "reward per step",
}


def test_no_example_is_forgotten() -> None:
    assert {path.name for path in EXAMPLES.glob("*.py")} == {call.split()[0] for call in CALLS}


@pytest.mark.parametrize("call", CALLS)
def test_an_example_runs(call: str, tmp_path: Path) -> None:
    script, *arguments = call.split()
    command = [sys.executable, str(EXAMPLES / script), *arguments, "--steps", "600"]
    done = subprocess.run(
        command, check=False, capture_output=True, text=True, cwd=tmp_path, timeout=300
    )
    assert done.returncode == 0, done.stderr
    assert CALLS[call] in done.stdout
