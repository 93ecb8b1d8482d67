"""The benchmark of the ROS 2 part runs; its figures mean nothing here."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "ros2.py"


@pytest.mark.nightly
def test_a_simulated_arm_and_a_policy_on_it_are_measured() -> None:
    command = [sys.executable, str(SCRIPT), "--parts", "sim", "deploy", "--seconds", "1"]
    done = subprocess.run(
        [*command, "--targets", "1"], check=False, capture_output=True, text=True, timeout=180
    )
    assert done.returncode == 0, done.stderr
    found = re.findall(r"^(\w+: [\w-]+), ", done.stdout, re.MULTILINE)
    profiles = ("trajectory", "forward", "mara-2019")
    assert found == ["sim: dart", "sim: mujoco", *(f"deploy: {name}" for name in profiles)]


@pytest.mark.slow
def test_the_filter_is_measured_with_and_without_collision_checks() -> None:
    command = [sys.executable, str(SCRIPT), "--parts", "filter", "--seconds", "1"]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    for name in ("kinematic checks", "with the collision checks"):
        line = rf"^filter: p50 \d+ µs, p99 \d+ µs, {name} \("
        assert len(re.findall(line, done.stdout, re.MULTILINE)) == 2
