"""Videos: writes pictures to an MP4 or GIF file."""

from __future__ import annotations

import os
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from gym_mara.errors import GymMaraError, unknown
from gym_mara.extras import needs
from gym_mara.rendering.renderer import Picture

with needs("films", "render", "imageio", "imageio-ffmpeg"):
    import imageio.v2 as imageio
    import imageio_ffmpeg  # noqa: F401 - imageio uses it to write MP4

FORMATS = (".mp4", ".gif")
HIGHEST_RATE = 50.0
"""The highest rate that every browser plays, also of a GIF, pictures per second."""


class Film:
    """Writes a video file; use it in a `with` statement.

    The file appears only when the video is complete: an error in the `with` block leaves no file.

    Args:
        path: a new file, with the ending .mp4 or .gif.
        rate: pictures per second.

    Raises:
        GymMaraError: the file exists, has another ending, or cannot be written.
    """

    def __init__(self, path: Path, rate: float) -> None:
        check_film_path(path)
        self._path = path
        self._partial = path.with_name(f".{path.stem}.partial{path.suffix}")
        options: dict[str, Any] = {"fps": rate, "codec": "libx264", "macro_block_size": 2}
        if path.suffix.lower() == ".gif":
            options = {"duration": 1000.0 / rate, "loop": 0}
        self._writer: Any = imageio.get_writer(self._partial, **options)

    def add(self, picture: Picture) -> None:
        """Add a picture (height, width, 3); all pictures must have the same size."""
        height, width = (side // 2 * 2 for side in picture.shape[:2])  # MP4 needs even sizes
        self._writer.append_data(np.ascontiguousarray(picture[:height, :width]))

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        try:
            self._writer.close()
            if error is None:
                os.replace(self._partial, self._path)
        finally:
            self._partial.unlink(missing_ok=True)


def check_film_path(path: Path) -> None:
    """Check that a video can be written to a path.

    Raises:
        GymMaraError: it cannot.
    """
    if path.suffix.lower() not in FORMATS:
        raise unknown("format of a video", path.suffix, FORMATS)
    if path.exists():
        raise GymMaraError(f"{str(path)!r} exists and is not overwritten: choose another name")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise GymMaraError(
            f"{str(path)!r} cannot be written: {str(path.parent)!r} is not a writable folder"
        )
