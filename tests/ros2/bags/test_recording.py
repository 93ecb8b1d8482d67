"""`gym-mara ros2 record` and `replay` with a simulated arm: bags of living topics, also of a recording that is killed."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from gym_mara.errors import GymMaraError
from gym_mara.ros2.bags import recording
from gym_mara.ros2.bags.bag import Bag
from tests.helpers import Cli, started

pytestmark = pytest.mark.slow


@contextmanager
def simulation() -> Iterator[None]:
    """An arm that reports its states."""
    with started(
        "-m", "gym_mara.cli", "ros2", "sim", "--backend", "mujoco", "--seconds", "60"
    ) as arm:
        assert arm.stdout is not None
        assert arm.stdout.readline().startswith("ready: ")
        yield


@contextmanager
def recorder(folder: Path) -> Iterator[subprocess.Popen[str]]:
    """A recording that has some seconds of messages."""
    with started("-m", "gym_mara.cli", "ros2", "record", str(folder)) as process:
        file, end = folder / f"{folder.name}.mcap", time.monotonic() + 30.0
        while not (file.exists() and file.stat().st_size > 20_000) and time.monotonic() < end:
            time.sleep(0.1)
        yield process


def states(folder: Path) -> int:
    with Bag(folder) as bag:
        return sum(1 for _ in bag.messages(["/joint_states"]))


def test_a_recording_is_replayed_and_ends_or_is_killed(
    tmp_path: Path, ros_domain: int, gym_mara: Cli
) -> None:
    with simulation():
        with recorder(tmp_path / "ended") as process:
            process.send_signal(signal.SIGTERM)
            assert process.wait(15.0) == 0
        with recorder(tmp_path / "killed") as process:
            process.kill()
    assert (tmp_path / "ended" / "metadata.yaml").exists()
    assert not (tmp_path / "killed" / "metadata.yaml").exists()
    assert states(tmp_path / "ended") > 40
    assert states(tmp_path / "killed") > 40
    code, output, error = gym_mara("ros2", "replay", tmp_path / "ended", "--rate", 10)
    assert code == 0
    assert "/joint_states" in output
    assert "no arm listens to" in error
    code, _, error = gym_mara("ros2", "record", tmp_path / "ended")
    assert code == 2
    assert "is not overwritten" in error


def test_without_an_arm(
    tmp_path: Path, ros_domain: int, gym_mara: Cli, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording, "PATIENCE", 0.5)
    code, _, error = gym_mara("ros2", "record", tmp_path / "bag", "--seconds", 0.2)
    assert code == 2
    assert "no messages came" in error
    code, _, error = gym_mara("ros2", "replay", tmp_path / "bag")
    assert code == 2
    assert "nothing to replay" in error


def test_messages_that_are_not_installed() -> None:
    with pytest.raises(GymMaraError, match="source a ROS that has my_msgs"):
        recording.message_class("my_msgs/msg/Mine")
