"""`gym-mara ros2 sim` as a process, commanded by a program that is not gym_mara's; and `gym-mara ros2 check` of it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rclpy")

from gym_mara.backends.randomisation import Randomisation
from gym_mara.cli import INTERRUPTED
from gym_mara.pretrained import pretrained_file
from gym_mara.robot import RobotModel
from tests.helpers import Cli, started

pytestmark = pytest.mark.slow
PEER = Path(__file__).with_name("plain_peer.py")


@contextmanager
def simulation(*options: str) -> Iterator[subprocess.Popen[str]]:
    """The command as a process that is ready."""
    with started("-m", "gym_mara.cli", "ros2", "sim", *options) as process:
        assert process.stdout is not None
        assert process.stdout.readline().startswith("ready: ")
        yield process


def peer(form: str, offset: float = 0.1) -> str:
    """What the other program prints."""
    arguments = [sys.executable, str(PEER), form, str(offset)]
    ended = subprocess.run(arguments, capture_output=True, text=True, timeout=40)
    assert ended.returncode == 0, ended.stderr
    return ended.stdout.strip()


def test_another_program_commands_it_in_all_forms(ros_domain: int) -> None:
    with simulation("--backend", "dart", "--seconds", "60"):
        assert [peer(form) for form in ("trajectory", "forward", "mara-2019")] == ["there"] * 3
        assert peer("bad") == "rests"


def test_another_program_commands_another_engine(ros_domain: int) -> None:
    with simulation("--backend", "mujoco", "--control-period", "0.004", "--seconds", "60"):
        assert peer("trajectory") == "there"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_when_it_is_interrupted(number: signal.Signals, ros_domain: int) -> None:
    with simulation("--backend", "pinocchio", "--set", "servo_gain=10") as process:
        process.send_signal(number)
        assert process.wait(15.0) == INTERRUPTED


def test_it_ends_after_its_time(ros_domain: int) -> None:
    with simulation("--backend", "mujoco", "--clock", "--seconds", "0.5") as process:
        assert process.wait(15.0) == 0


def test_a_check_is_green_with_it_and_red_without(
    gym_mara: Cli, mara: RobotModel, ros_domain: int, tmp_path: Path
) -> None:
    policy = pretrained_file("MARAReach-v0")

    def check(name: str, *options: object) -> tuple[int, set[str], dict[str, Any]]:
        """The exit code, what is wrong but for times on a busy machine, and the figures."""
        file = tmp_path / name
        code, _, _ = gym_mara("ros2", "check", *options, "--json", file)
        figures = json.loads(file.read_text())
        wrong = {line["what"] for line in figures["lines"] if not line["ok"]}
        assert code == int(bool(wrong)) == int(not figures["ok"])
        return code, wrong - {"rate", "jitter", "age of states", "transport"}, figures

    with simulation("--seconds", "60"):
        _, wrong, figures = check("good.json", policy)
        assert not wrong
        assert 30.0 < figures["rate"] < 60.0
        low, high = figures["latency"]
        assert 0.02 <= low <= high < 0.5
        Randomisation({"latency": figures["latency"]}, mara)  # as it is
        assert not check("mara.json", "--profile", "mara-2019", "--seconds", "0.5")[1]
        code, wrong, _ = check("other.json", "--controller", "other", "--seconds", "0.5")
        assert (code, wrong) == (1, {"commands"})
    code, wrong, figures = check("none.json", "--seconds", "0.5", "--domain", 102)
    assert (code, wrong, figures["latency"]) == (1, {"states", "commands"}, None)


def test_a_browser_can_show_it(ros_domain: int) -> None:
    with started("-m", "gym_mara.cli", "ros2", "sim", "--view", "--seconds", "30") as process:
        assert process.stdout is not None
        address = next(line for line in process.stdout if line.startswith("view: ")).split()[-1]
        with urllib.request.urlopen(address, timeout=10.0) as response:
            assert response.status == 200


def test_the_control_period_has_one_option(gym_mara: Cli) -> None:
    code, _, error = gym_mara("ros2", "sim", "--set", "control_period=0.01", "--seconds", "0.1")
    assert (code, "give --control-period" in error) == (2, True)
