"""Videos: writes pictures to an MP4 or GIF file."""

from __future__ import annotations

import os
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from gym_mara.errors import GymMaraError, unknown
from gym_mara.extras import needs
from gym_mara.files import written_aside
from gym_mara.rendering.renderer import Picture

with needs("a film", "render", "imageio", "imageio-ffmpeg", "pillow"):
    import imageio.v2 as imageio
    import imageio_ffmpeg
    from PIL import Image, ImageDraw, ImageFont

_TEXT_COLOUR = (40, 44, 52)
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
        self._path, self._pictures = path, 0
        self._rate = rate

    def add(self, picture: Picture) -> None:
        """Add a picture (height, width, 3); all pictures must have the same size.

        Raises:
            GymMaraError: the file cannot be written.
        """
        height, width = (side // 2 * 2 for side in picture.shape[:2])  # MP4 needs even sizes
        try:
            self._writer.append_data(np.ascontiguousarray(picture[:height, :width]))
        except OSError as error:  # that of FFmpeg has many lines
            raise self._incomplete() from error
        self._pictures += 1

    def __enter__(self) -> Film:
        with ExitStack() as stack:
            self._temporary = stack.enter_context(written_aside(self._path, new=True))
            stack.push(self._check)
            self._writer: Any
            if self._path.suffix.lower() == ".gif":
                self._writer = _Gif(self._temporary, self._rate)
            else:
                self._writer = imageio.get_writer(
                    self._temporary, fps=self._rate, codec="libx264", macro_block_size=2
                )
            stack.callback(self._writer.close)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self,
        error_type: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._stack.__exit__(error_type, error, traceback)

    def _check(self, error_type: type[BaseException] | None, *_: Any) -> None:
        """Check that an MP4 file is complete: imageio does not tell when FFmpeg fails."""
        if error_type is None and self._path.suffix.lower() == ".mp4":
            try:
                written, _seconds = imageio_ffmpeg.count_frames_and_secs(str(self._temporary))
            except RuntimeError as error:
                raise self._incomplete() from error
            if written < self._pictures:
                raise self._incomplete()

    def _incomplete(self) -> GymMaraError:
        return GymMaraError(
            f"{str(self._path)!r} could not be written to its end: is the disk full?"
        )


class _Gif:
    """Writes a GIF file when it is closed. imageio would try again at the end of the process where the disk is full."""

    def __init__(self, file: Path, rate: float) -> None:
        self._file, self._rate = file, rate
        self._pictures: list[Image.Image] = []

    def append_data(self, picture: Picture) -> None:
        # As Pillow does when it writes: a third of the memory until then.
        coloured = Image.fromarray(picture).convert("P", palette=Image.Palette.ADAPTIVE)
        self._pictures.append(coloured)

    def close(self) -> None:
        if self._pictures:  # without one, the error that came before it is told
            first, *others = self._pictures
            # A GIF counts hundredths of a second: each picture begins at the nearest one, so that the errors do not add up.
            begins = np.round(np.arange(len(self._pictures) + 1) * 100.0 / self._rate)
            times = (10.0 * np.diff(begins)).tolist()
            first.save(self._file, save_all=True, append_images=others, duration=times, loop=0)


def check_film_path(path: Path) -> None:
    """Check that a video can be written to a path.

    Raises:
        GymMaraError: it cannot.
    """
    if path.suffix.lower() not in FORMATS:
        raise unknown("format of a video", path.suffix, FORMATS)
    if os.path.lexists(path):
        raise GymMaraError(f"{str(path)!r} exists and is not overwritten: choose another name")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise GymMaraError(
            f"{str(path)!r} cannot be written: {str(path.parent)!r} is not a writable folder"
        )


def labelled(picture: Picture, text: str) -> Picture:
    """A copy of a picture (height, width, 3) with a text at the top."""
    image = Image.fromarray(picture)
    size = max(10, picture.shape[0] // 22)
    font, margin = ImageFont.load_default(size), size // 2
    ImageDraw.Draw(image).text((margin, margin), text, fill=_TEXT_COLOUR, font=font)
    return np.asarray(image)
