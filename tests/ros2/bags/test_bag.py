"""Bags: written and read again, unfinished ones, and damaged ones, which are errors and nothing else."""

from __future__ import annotations

import random
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys.stores import ros2_jazzy as types

from gym_mara.errors import GymMaraError
from gym_mara.files import DamagedFileError, MissingFileError
from gym_mara.identification import Log
from gym_mara.robot import RobotModel
from gym_mara.ros2.bags import bag as bags
from gym_mara.ros2.bags.bag import Bag, Recorder
from gym_mara.ros2.bags.logs import read_log, write_episode


def some_log(robot: RobotModel, ticks: int = 120) -> Log:
    generator = np.random.default_rng(0)
    q, qd, targets = 0.1 * generator.standard_normal((3, ticks, robot.num_joints))
    return Log(np.arange(ticks) * np.float64(0.02), targets, q, qd, robot.joint_names)


def test_the_files_are_those_of_a_bag(tmp_path: Path) -> None:
    with Recorder(tmp_path / "bag") as recorder:
        for time in (5, 9, 7):  # the last one is written as 9
            recorder.add_value("/words", types.std_msgs__msg__String(f"at {time}"), time)
    assert recorder.counts == {"/words": 3}
    assert {file.name for file in (tmp_path / "bag").iterdir()} == {"metadata.yaml", "bag.mcap"}
    with Reader(tmp_path / "bag") as reader:
        (connection,) = reader.connections
        assert connection.msgdef.data.strip() == "string data"
        assert connection.digest.startswith("RIHS01_")
        assert reader.message_count == 3
    with Bag(tmp_path / "bag") as bag:
        found = [(m.topic, m.time, m.value.data) for m in bag.messages(["/words"])]
        assert found == [("/words", 5, "at 5"), ("/words", 9, "at 9"), ("/words", 9, "at 7")]
        assert list(bag.messages(["/others"])) == []


def test_nothing_is_overwritten(tmp_path: Path) -> None:
    folder = tmp_path / "bag"
    folder.mkdir()
    with pytest.raises(GymMaraError, match="exists and is not overwritten"):
        Recorder(folder)
    assert list(folder.iterdir()) == []


def test_what_cannot_be_recorded_is_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "bag") as recorder:
        assert not recorder.knows("my_msgs/msg/Mine")
        with pytest.raises(GymMaraError, match="no definition here"):
            recorder.add("/mine", "my_msgs/msg/Mine", b"", 0)
        recorder.add("/a", "std_msgs/msg/String", b"\0" * 12, 0)
        with pytest.raises(GymMaraError, match=r"/a are std_msgs/msg/String and std_msgs/msg/Bool"):
            recorder.add("/a", "std_msgs/msg/Bool", b"\0" * 12, 0)
    with pytest.raises(GymMaraError, match="cannot write the bag"):
        Recorder(tmp_path / "bag" / "metadata.yaml" / "below")


def test_a_full_disk_is_an_error(tmp_path: Path, small_files: None) -> None:
    with (
        pytest.raises(GymMaraError, match="cannot write the bag"),
        Recorder(tmp_path / "b") as recorder,
    ):
        recorder.add("/a", "std_msgs/msg/String", bytes(3_000_000), 0)


def test_a_recording_that_was_killed_is_read_up_to_its_last_chunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bags, "CHUNK", 0.0)  # each message is a chunk
    recorder = Recorder(tmp_path / "bag")
    for time in range(20):
        recorder.add_value("/words", types.std_msgs__msg__String(str(time)), time)
    file = tmp_path / "bag" / "bag.mcap"
    data = file.read_bytes()  # what the disk has when the process is killed
    recorder.close()
    (tmp_path / "bag" / "metadata.yaml").unlink()
    counts = []
    for size in range(60, len(data) + 1, 37):
        file.write_bytes(data[:size])
        with Bag(tmp_path / "bag") as bag:
            counts.append(sum(1 for _ in bag.messages(["/words"])))
    file.write_bytes(data)
    with Bag(tmp_path / "bag") as bag:
        counts.append(sum(1 for _ in bag.messages(["/words"])))
    assert counts == sorted(counts)
    assert (counts[0], counts[-1]) == (0, 20)


def test_missing_and_other_files(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match="no such folder"):
        Bag(tmp_path / "none")
    (tmp_path / "empty").mkdir()
    with pytest.raises(DamagedFileError, match="is not a bag"):
        Bag(tmp_path / "empty")
    (tmp_path / "text.mcap").write_text("hello")
    (tmp_path / "empty" / "text.mcap").write_text("hello")
    for path in (tmp_path / "text.mcap", tmp_path / "empty"):
        with pytest.raises(DamagedFileError, match="cannot read"):
            Bag(path)
    (tmp_path / "other.txt").write_text("hello")
    with pytest.raises(DamagedFileError, match="Unrecognized"):
        Bag(tmp_path / "other.txt")


def test_huge_files_are_refused(
    tmp_path: Path, mara: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_episode(tmp_path / "bag", some_log(mara), mara)
    monkeypatch.setattr(bags, "LARGEST", 1000)
    with pytest.raises(DamagedFileError, match="larger than 1,000 bytes"):
        Bag(tmp_path / "bag")


@pytest.mark.parametrize(
    "text", ["", "- 1", "a: [", "rosbag2_bagfile_information: {version: 99}", "\0"]
)
def test_damaged_metadata(text: str, tmp_path: Path, mara: RobotModel) -> None:
    write_episode(tmp_path / "bag", some_log(mara), mara)
    (tmp_path / "bag" / "metadata.yaml").write_text(text)
    with pytest.raises(DamagedFileError):
        read_log(tmp_path / "bag", mara)


@pytest.mark.parametrize("with_metadata", [False, True])
def test_any_truncation_is_an_error_or_a_log(
    with_metadata: bool, tmp_path: Path, mara: RobotModel
) -> None:
    write_episode(tmp_path / "bag", some_log(mara), mara)
    file = tmp_path / "bag" / "bag.mcap"
    data = file.read_bytes()
    if not with_metadata:
        (tmp_path / "bag" / "metadata.yaml").unlink()
    sizes = [
        *range(0, 200, 19),
        *range(200, len(data), len(data) // 20),
        *range(len(data) - 60, len(data), 4),
    ]
    read = 0
    for size in sizes:
        file.write_bytes(data[:size])
        try:
            read += len(read_log(tmp_path / "bag", mara).times) == 120
        except GymMaraError:
            continue
    assert (read > 0) is not with_metadata


def test_any_damage_is_an_error_or_a_log(tmp_path: Path, mara: RobotModel) -> None:
    write_episode(tmp_path / "bag", some_log(mara), mara)
    file = tmp_path / "bag" / "bag.mcap"
    data, generator = file.read_bytes(), random.Random(0)
    for _ in range(30):
        damaged = bytearray(data)
        # Half of the damage is near the ends, where the lengths and offsets are.
        near = generator.choice((len(data), 3000))
        for _ in range(generator.randint(1, 4)):
            damaged[generator.choice((1, -1)) * generator.randrange(near)] = generator.randrange(
                256
            )
        file.write_bytes(damaged)
        try:
            read_log(tmp_path / "bag", mara)
        except GymMaraError:
            continue
