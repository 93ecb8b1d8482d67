"""Films: pictures one after the other, as MP4 or GIF."""

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
    import imageio_ffmpeg  # noqa: F401 - imageio writes MP4 with it

FORMATS = (".mp4", ".gif")
HIGHEST_RATE = 50.0
"""Pictures per second that every browser plays, also of a GIF."""


class Film:
    """Writes pictures to a file, which is there once the film is whole; use it in a `with` statement.

    Args:
        path: a new file, .mp4 or .gif.
        rate: pictures per second.

    Raises:
        GymMaraError: the file exists, its format is another, or it cannot be written.
    """

    def __init__(self, path: Path, rate: float) -> None:
        check_film_path(path)
        self._path = path
        self._half = path.with_name(f".{path.stem}.half{path.suffix}")
        options: dict[str, Any] = {"fps": rate, "codec": "libx264", "macro_block_size": 2}
        if path.suffix.lower() == ".gif":
            options = {"duration": 1000.0 / rate, "loop": 0}
        self._writer: Any = imageio.get_writer(self._half, **options)

    def add(self, picture: Picture) -> None:
        """Add a picture (height, width, 3); all are of one size."""
        height, width = (side // 2 * 2 for side in picture.shape[:2])  # MP4 wants them even
        self._writer.append_data(np.ascontiguousarray(picture[:height, :width]))

    def __enter__(self) -> Film:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self._writer.close()
            if kind is None:
                os.replace(self._half, self._path)
        finally:
            self._half.unlink(missing_ok=True)


def check_film_path(path: Path) -> None:
    """Raise GymMaraError where no film can be written to a path."""
    if path.suffix.lower() not in FORMATS:
        raise unknown("format of a video", path.suffix, FORMATS)
    if path.exists():
        raise GymMaraError(f"{str(path)!r} exists and is not overwritten: choose another name")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise GymMaraError(
            f"{str(path)!r} cannot be written: {str(path.parent)!r} is no folder that may be written to"
        )
