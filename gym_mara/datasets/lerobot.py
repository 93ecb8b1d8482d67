"""Data sets of LeRobot, in version 3.0 of its format: tables in Parquet, videos, and their description in JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.datasets.contents import Contents
from gym_mara.datasets.episode import Episode
from gym_mara.datasets.formats import Writer
from gym_mara.datasets.lerobot_files import (
    EPISODES,
    FILES_OF_A_FOLDER,
    LARGEST_TABLE,
    LARGEST_VIDEO,
    TABLES,
    VIDEOS,
    Tables,
    Videos,
)
from gym_mara.datasets.statistics import Statistics, merged, of_pictures, of_values
from gym_mara.errors import GymMaraError
from gym_mara.extras import needs
from gym_mara.files import write_json

with needs("a data set of LeRobot", "lerobot"):
    import pandas
    import pyarrow

VERSION = "v3.0"
STATE, ACTION, CAMERA = "observation.state", "action", "observation.images.camera"
_ROWS = 50
"""The descriptions of so many episodes are written at a time."""


class LeRobotWriter(Writer):
    """Writes the folder of a data set of LeRobot, one episode after the other.

    `LeRobotDataset(name, root=folder)` reads it, with any name.

    Raises:
        GymMaraError: the control period is no whole number of steps a second.
    """

    def __init__(self, folder: Path, name: str, contents: Contents) -> None:
        self._folder, self._contents = folder, contents
        self._rate = round(1.0 / contents.control_period)
        if abs(self._rate * contents.control_period - 1.0) > 1e-9:
            raise GymMaraError(
                "data sets of LeRobot have a whole number of frames a second, and a control period of "
                f"{contents.control_period:g} s makes {1.0 / contents.control_period:g}: choose another control_period"
            )
        self._tables, self._episodes = Tables(folder, TABLES), Tables(folder, EPISODES)
        self._videos: Videos | None = None
        if contents.pictures is not None:
            self._videos = Videos(folder, CAMERA, contents.pictures.width, self._rate)
        self._features: dict[str, Any] = {}
        self._rows: list[dict[str, Any]] = []
        self._statistics: dict[str, Statistics] = {}
        self._count = self._frames = 0

    def add(self, episode: Episode) -> None:
        columns = self._columns(episode)
        statistics = {name: of_values(values) for name, values in columns.items()}
        row = self._row(len(episode.rewards))
        self._tables.add(pyarrow.table({name: _array(v) for name, v in columns.items()}))
        if self._videos is not None:
            assert episode.pixels is not None
            pictures = episode.pixels[:-1]  # a frame is an observation and the action that follows
            row |= self._videos.add(pictures)
            statistics[CAMERA] = of_pictures(pictures)
        for name, found in statistics.items():
            row |= {f"stats/{name}/{key}": values.tolist() for key, values in found.items()}
            before = self._statistics.get(name)
            self._statistics[name] = found if before is None else merged(before, found)
        self._features = {name: self._feature(name, v) for name, v in columns.items()}
        self._count, self._frames = self._count + 1, self._frames + len(episode.rewards)
        self._rows.append(row)
        if len(self._rows) == _ROWS:
            self._describe()

    def _columns(self, episode: Episode) -> dict[str, NDArray[Any]]:
        """What an episode is in a table, each (T, K)."""
        length = len(episode.rewards)
        numbers = np.arange(length)
        state = np.concatenate([episode.states[k] for k in self._contents.state_names], axis=1)
        columns: dict[str, NDArray[Any]] = {
            STATE: state[:-1].astype(np.float32),
            ACTION: episode.actions,
            "next.reward": episode.rewards.astype(np.float32),
            "next.done": numbers == length - 1,
            "next.truncated": episode.truncated,
        }
        if episode.success is not None:
            columns["next.success"] = episode.success
        columns |= {
            "timestamp": (numbers / self._rate).astype(np.float32),
            "frame_index": numbers,
            "episode_index": np.full(length, self._count),
            "index": self._frames + numbers,
            "task_index": np.zeros(length, np.int64),
        }
        return {name: values.reshape(length, -1) for name, values in columns.items()}

    def _row(self, length: int) -> dict[str, Any]:
        """The description of the next episode, of this many frames."""
        place = self._tables.indices
        return {
            "episode_index": self._count,
            "tasks": [self._contents.spec.id],
            "length": length,
            "dataset_from_index": self._frames,
            "dataset_to_index": self._frames + length,
            **{f"data/{name}": index for name, index in place.items()},
        }

    def _feature(self, name: str, values: NDArray[Any]) -> dict[str, Any]:
        names: dict[str, list[str]] = {
            STATE: [n for each in self._contents.state_names.values() for n in each],
            ACTION: list(self._contents.action_names),
        }
        shape = [values.shape[1]]
        return {"dtype": str(values.dtype), "shape": shape, "names": names.get(name)}

    def _describe(self) -> None:
        """Write the descriptions of the last episodes."""
        if self._rows:
            place = {f"meta/episodes/{name}": i for name, i in self._episodes.indices.items()}
            rows = [row | place for row in self._rows]
            self._episodes.add(pyarrow.Table.from_pylist(rows))
            self._rows = []

    def finish(self) -> None:
        self._describe()
        for files in (self._tables, self._episodes, self._videos):
            if files is not None:
                files.finish()
        meta = self._folder / "meta"
        tasks = pandas.DataFrame({"task_index": [0]}, index=[self._contents.spec.id])
        tasks.to_parquet(meta / "tasks.parquet")
        plain = {
            name: {key: values.tolist() for key, values in found.items()}
            for name, found in self._statistics.items()
        }
        write_json(meta / "stats.json", plain)
        write_json(meta / "info.json", self._info())

    def _info(self) -> dict[str, Any]:
        features, video_path = self._features, None
        if self._videos is not None:
            features, video_path = {**features, CAMERA: self._videos.feature}, VIDEOS
        return {
            "codebase_version": VERSION,
            "robot_type": self._contents.robot,
            "total_episodes": self._count,
            "total_frames": self._frames,
            "total_tasks": 1,
            "chunks_size": FILES_OF_A_FOLDER,
            "data_files_size_in_mb": LARGEST_TABLE,
            "video_files_size_in_mb": LARGEST_VIDEO,
            "fps": self._rate,
            "splits": {"train": f"0:{self._count}"},
            "data_path": TABLES,
            "video_path": video_path,
            "features": features,
        }

    def close(self) -> None:
        for files in (self._tables, self._episodes, self._videos):
            if files is not None:
                files.close()


def _array(values: NDArray[Any]) -> Any:
    """Values (T, K) as a column: of numbers where K is 1, else of lists."""
    flat = pyarrow.array(np.ascontiguousarray(values).reshape(-1))
    size = values.shape[1]
    return flat if size == 1 else pyarrow.FixedSizeListArray.from_arrays(flat, size)
