"""The numbered files of a data set of LeRobot: tables in Parquet, and videos in H.264."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.extras import needs

with needs("a data set of LeRobot", "lerobot"):
    import imageio_ffmpeg
    import pyarrow.parquet

FILES_OF_A_FOLDER = 1000
LARGEST_TABLE, LARGEST_VIDEO = 100, 200
"""An episode that follows so many MB goes into the next file."""
PLACE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
TABLES = f"data/{PLACE}.parquet"
EPISODES = f"meta/episodes/{PLACE}.parquet"
VIDEOS = f"videos/{{video_key}}/{PLACE}.mp4"
CODEC, PIXEL_FORMAT = "h264", "yuv420p"
_ENCODING = ["-g", "2", "-bf", "0", "-crf", "18"]
"""Every second picture is complete, as in LeRobot's own videos; none needs a later one; little is lost."""


class _Files:
    """Files of one kind, which are filled one after the other."""

    def __init__(self, folder: Path, pattern: str, largest: float, **names: str) -> None:
        self._folder, self._pattern, self._names = folder, pattern, names
        self._largest, self._number = 1e6 * largest, 0

    @property
    def indices(self) -> dict[str, int]:
        """The numbers of the current file, in the names that LeRobot has for them."""
        chunk, file = divmod(self._number, FILES_OF_A_FOLDER)
        return {"chunk_index": chunk, "file_index": file}

    def _new(self) -> Path:
        """The path of the current file, whose folder is made."""
        path = self._path
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    @property
    def _path(self) -> Path:
        return self._folder / self._pattern.format(**self._names, **self.indices)

    def _is_full(self) -> bool:
        path = self._path
        return (path.stat().st_size if path.exists() else 0) >= self._largest


class Tables(_Files):
    """Writes rows, all with the same columns. An error of the file is an OSError."""

    def __init__(self, folder: Path, pattern: str) -> None:
        super().__init__(folder, pattern, LARGEST_TABLE)
        self._writer: Any = None

    def add(self, rows: Any) -> None:
        """Write a table of pyarrow, after those before it."""
        if self._writer is None:
            self._writer = pyarrow.parquet.ParquetWriter(self._new(), rows.schema)
        self._writer.write_table(rows)
        if self._is_full():
            self.finish()
            self._number += 1

    def finish(self) -> None:
        """Complete the current file."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def close(self) -> None:
        """Let go of the file."""
        with suppress(Exception):
            self.finish()


class Videos(_Files):
    """Writes the pictures of episodes. An error of the file or of FFmpeg is an OSError.

    Args:
        folder: of the data set.
        key: the feature of the pictures.
        pixels: their width and height, an even number.
        rate: pictures per second.
    """

    def __init__(self, folder: Path, key: str, pixels: int, rate: int) -> None:
        super().__init__(folder, VIDEOS, LARGEST_VIDEO, video_key=key)
        self._key, self._pixels, self._rate = key, pixels, rate
        self._writer: Generator[None, Any, None] | None = None
        self._pictures = 0  # in the current file

    def add(self, pictures: NDArray[np.uint8]) -> dict[str, Any]:
        """Write the pictures (T, height, width, 3), RGB, of an episode; returns where they are, as LeRobot stores it."""
        if self._writer is None:
            self._begin()
        assert self._writer is not None
        first, self._pictures = self._pictures, self._pictures + len(pictures)
        found = self.indices | {
            "from_timestamp": first / self._rate,
            "to_timestamp": self._pictures / self._rate,
        }
        try:
            for picture in pictures:
                self._writer.send(np.ascontiguousarray(picture))
        except (OSError, StopIteration) as error:  # that of FFmpeg has many lines
            raise self._incomplete() from error
        if self._is_full():
            self.finish()
            self._number += 1
        return {f"videos/{self._key}/{name}": value for name, value in found.items()}

    def _begin(self) -> None:
        self._pictures = 0
        self._writer = imageio_ffmpeg.write_frames(
            str(self._new()),
            (self._pixels, self._pixels),
            fps=self._rate,
            codec="libx264",
            pix_fmt_out=PIXEL_FORMAT,
            macro_block_size=2,
            quality=None,  # that of _ENCODING
            output_params=_ENCODING,
        )
        self._writer.send(None)

    def finish(self) -> None:
        """Complete the current file."""
        writer, self._writer = self._writer, None
        if writer is None:
            return
        try:
            writer.close()
            written, _ = imageio_ffmpeg.count_frames_and_secs(str(self._path))
        except (OSError, RuntimeError) as error:
            raise self._incomplete() from error
        if written != self._pictures:  # FFmpeg does not tell
            raise self._incomplete()

    def close(self) -> None:
        """End FFmpeg, if it runs."""
        with suppress(Exception):
            if self._writer is not None:
                self._writer.close()

    def _incomplete(self) -> OSError:
        return OSError(f"FFmpeg could not write {self._path.name} to its end: is the disk full?")

    @property
    def feature(self) -> dict[str, Any]:
        """What the pictures are, as LeRobot stores it."""
        return {
            "dtype": "video",
            "shape": [self._pixels, self._pixels, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": self._pixels,
                "video.width": self._pixels,
                "video.codec": CODEC,
                "video.pix_fmt": PIXEL_FORMAT,
                "video.is_depth_map": False,
                "video.fps": self._rate,
                "video.channels": 3,
                "has_audio": False,
            },
        }
