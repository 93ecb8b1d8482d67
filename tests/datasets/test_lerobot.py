"""Data sets of LeRobot: every file and every key that its loader reads. `make test-lerobot` reads one with LeRobot itself."""

from __future__ import annotations

import json
from contextlib import closing
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pandas
import pyarrow.parquet
import pytest

from gym_mara.datasets import lerobot, lerobot_files
from gym_mara.datasets.episode import Episode
from gym_mara.datasets.playing import record
from gym_mara.datasets.sources import baseline
from gym_mara.datasets.statistics import QUANTILES, merged, of_values
from gym_mara.errors import GymMaraError
from gym_mara.registration import ENVIRONMENTS
from tests.helpers import Cli

# imageio leaves the pipes of the FFmpeg from which it has read a film to the garbage collector.
pytestmark = pytest.mark.filterwarnings(
    "ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning"
)

LENGTH = 4
OPTIONS = {"max_joint_velocity": 1.5}
COLUMNS = ("timestamp", "frame_index", "episode_index", "index", "task_index")
"""What every table of LeRobot has, beside its features."""


@pytest.fixture(autouse=True)
def _short_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("MARA-v0", "MARAGoal-v0"):
        short = ENVIRONMENTS[name]._replace(max_episode_steps=LENGTH)
        monkeypatch.setitem(ENVIRONMENTS, name, short)


@pytest.fixture
def written(monkeypatch: pytest.MonkeyPatch) -> list[Episode]:
    """The episodes that are written."""
    episodes: list[Episode] = []
    add = lerobot.LeRobotWriter.add

    def noting(writer: lerobot.LeRobotWriter, episode: Episode) -> None:
        episodes.append(episode)
        add(writer, episode)

    monkeypatch.setattr(lerobot.LeRobotWriter, "add", noting)
    return episodes


def read(folder: Path, pattern: str, **names: Any) -> Any:
    """The rows of a table as dictionaries."""
    return pyarrow.parquet.read_table(folder / pattern.format(**names)).to_pylist()


def test_a_data_set_has_all_that_the_loader_reads(
    gym_mara: Cli, tmp_path: Path, written: list[Episode]
) -> None:
    call = "record --policy ik --env MARAGoal-v0 --set max_joint_velocity=1.5 --episodes 3 --format lerobot --pixels 64"
    assert gym_mara(*call.split(), "--out", str(tmp_path / "new"))[0] == 0
    folder = tmp_path / "new"
    info = json.loads((folder / "meta" / "info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["fps"], info["robot_type"]) == (50, "mara")
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 3 * LENGTH, 1)
    assert info["splits"] == {"train": "0:3"}
    tasks = pandas.read_parquet(folder / "meta" / "tasks.parquet")
    assert tasks.loc["gym_mara/MARAGoal-v0"].task_index == 0

    features = info["features"]
    expected = {"observation.state", "action", "next.reward", "next.done", "next.truncated"}
    expected |= {"next.success", "observation.images.camera", *COLUMNS}
    assert set(features) == expected
    table = pyarrow.parquet.read_table(
        folder / info["data_path"].format(chunk_index=0, file_index=0)
    )
    rows = table.to_pylist()
    assert set(table.column_names) == expected - {"observation.images.camera"}
    for name in table.column_names:
        kind, [size] = table.schema.field(name).type, features[name]["shape"]
        assert str(kind.value_type if size > 1 else kind) == {"float32": "float"}.get(
            features[name]["dtype"], features[name]["dtype"]
        )
        assert size == 1 or kind.list_size == size
        assert features[name]["names"] is None or len(features[name]["names"]) == size
    assert features["action"]["names"][0] == "motor1"

    names = features["observation.state"]["names"]
    place = names.index("target_position_0")
    for number, episode in enumerate(written):
        state = rows[number * LENGTH]["observation.state"]
        np.testing.assert_allclose(
            state[place : place + 3], episode.states["desired_goal"][0], rtol=1e-6
        )
    for number, episode in enumerate(written):
        own = rows[number * LENGTH : (number + 1) * LENGTH]
        np.testing.assert_array_equal([row["action"] for row in own], episode.actions)
        np.testing.assert_allclose([row["next.reward"] for row in own], episode.rewards, rtol=1e-6)
        assert [row["next.done"] for row in own] == [False] * (LENGTH - 1) + [True]
        assert episode.success is not None
        assert [row["next.success"] for row in own] == episode.success.tolist()
        assert [row["episode_index"] for row in own] == [number] * LENGTH
        assert [row["frame_index"] for row in own] == list(range(LENGTH))
        np.testing.assert_allclose([row["timestamp"] for row in own], np.arange(LENGTH) / 50)
    assert [row["index"] for row in rows] == list(range(3 * LENGTH))


def test_the_pictures_of_an_episode_are_where_its_description_says(
    tmp_path: Path, written: list[Episode]
) -> None:
    folder = tmp_path / "new"
    record(
        baseline("ik", "MARA-v0", "pinocchio", OPTIONS), "lerobot", folder, episodes=2, pixels=64
    )
    info = json.loads((folder / "meta" / "info.json").read_text())
    about = read(folder, "meta/episodes/chunk-000/file-000.parquet")
    key = "observation.images.camera"
    for row, episode in zip(about, written, strict=True):
        place = {n: row[f"videos/{key}/{n}"] for n in ("chunk_index", "file_index")}
        film = imageio.imread(folder / info["video_path"].format(video_key=key, **place))
        first, end = (round(50 * row[f"videos/{key}/{n}_timestamp"]) for n in ("from", "to"))
        assert end - first == row["length"] == LENGTH
        shown = film[first:end].astype(float)
        assert episode.pixels is not None
        assert np.abs(shown - episode.pixels[:-1]).mean() < 4.0
        assert np.shape(row[f"stats/{key}/mean"]) == (3, 1, 1)
        channels = episode.pixels[:-1].mean(axis=(0, 1, 2)) / 255.0
        np.testing.assert_allclose(np.ravel(row[f"stats/{key}/mean"]), channels)
    assert info["features"][key]["shape"] == [64, 64, 3]


def test_files_are_numbered_when_one_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot_files, "LARGEST_TABLE", 1e-6)
    monkeypatch.setattr(lerobot_files, "LARGEST_VIDEO", 0.0)
    monkeypatch.setattr(lerobot_files, "FILES_OF_A_FOLDER", 2)
    monkeypatch.setattr(lerobot, "_ROWS", 2)
    folder = tmp_path / "new"
    record(
        baseline("ik", "MARA-v0", "pinocchio", OPTIONS), "lerobot", folder, episodes=3, pixels=32
    )
    paths = sorted(str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file())
    places = ("chunk-000/file-000", "chunk-000/file-001", "chunk-001/file-000")
    assert paths == sorted(
        [
            *(f"data/{place}.parquet" for place in places),
            *(f"meta/episodes/{place}.parquet" for place in places[:2]),
            *(f"videos/observation.images.camera/{place}.mp4" for place in places),
            *(f"meta/{name}" for name in ("info.json", "stats.json", "tasks.parquet")),
        ]
    )
    about = read(folder, "meta/episodes/chunk-000/file-001.parquet")
    assert [row["episode_index"] for row in about] == [2]
    assert about[0]["meta/episodes/file_index"] == 1
    for kind in ("data", "videos/observation.images.camera"):
        assert (about[0][f"{kind}/chunk_index"], about[0][f"{kind}/file_index"]) == (1, 0)
    assert about[0]["videos/observation.images.camera/from_timestamp"] == 0.0
    assert (about[0]["dataset_from_index"], about[0]["dataset_to_index"]) == (8, 12)


def test_the_statistics_of_episodes_merge_to_those_of_all(
    tmp_path: Path, written: list[Episode]
) -> None:
    folder = tmp_path / "new"
    record(baseline("ik", "MARAGoal-v0", "pinocchio", OPTIONS), "lerobot", folder, episodes=3)
    statistics = json.loads((folder / "meta" / "stats.json").read_text())
    about = read(folder, "meta/episodes/chunk-000/file-000.parquet")
    actions = np.concatenate([episode.actions for episode in written])
    for name in ("min", "max", "mean", "std"):
        np.testing.assert_allclose(
            statistics["action"][name], getattr(actions, name)(axis=0), rtol=1e-5, atol=1e-7
        )
        own = getattr(written[1].actions, name)(axis=0)
        np.testing.assert_allclose(about[1][f"stats/action/{name}"], own, rtol=1e-5, atol=1e-7)
    assert statistics["action"]["count"] == [3 * LENGTH]
    assert set(statistics["next.reward"]) == {"min", "max", "mean", "std", "count", *QUANTILES}
    assert len(statistics["next.reward"]["q50"]) == 1


def test_groups_of_different_sizes_merge() -> None:
    values = np.random.default_rng(0).normal(size=(50, 3)) ** 3
    both, whole = merged(of_values(values[:7]), of_values(values[7:])), of_values(values)
    for name in ("min", "max", "mean", "std", "count"):
        np.testing.assert_allclose(both[name], whole[name])
    assert (both["q01"] >= both["min"]).all()
    assert (both["q01"] < both["q99"]).all()


def test_a_rate_that_is_no_whole_number_is_refused(tmp_path: Path) -> None:
    source = baseline("ik", "MARA-v0", "pinocchio", {**OPTIONS, "control_period": 0.03})
    with pytest.raises(GymMaraError, match=r"whole number of frames a second.*33\.3"):
        record(source, "lerobot", tmp_path / "new", episodes=1)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_leaves_nothing(tmp_path: Path, small_files: None) -> None:
    with pytest.raises(GymMaraError, match=r"cannot write .*new': .*File too large"):
        record(baseline("ik", "MARA-v0", "pinocchio", {}), "lerobot", tmp_path / "new", episodes=1)
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_fills_up_ends_a_video_with_an_error(tmp_path: Path, small_files: None) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (30, 64, 64, 3), np.uint8)
    videos = lerobot_files.Videos(tmp_path, "observation.images.camera", 64, 50)

    def write() -> None:
        for _ in range(2):
            videos.add(noise)
        videos.finish()

    with closing(videos), pytest.raises(OSError, match="is the disk full") as refused:
        write()
    assert len(str(refused.value).splitlines()) == 1


def test_what_is_not_complete_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def too_few(path: str) -> tuple[int, float]:
        return LENGTH - 1, 0.08

    monkeypatch.setattr("imageio_ffmpeg.count_frames_and_secs", too_few)
    source = baseline("ik", "MARA-v0", "pinocchio", OPTIONS)
    with pytest.raises(GymMaraError, match="is the disk full"):
        record(source, "lerobot", tmp_path / "new", episodes=1, pixels=32)
    assert list(tmp_path.iterdir()) == []
