"""Data sets of Minari, written by its own storage class."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gym_mara.datasets.contents import Contents
from gym_mara.datasets.episode import Episode
from gym_mara.datasets.formats import Writer
from gym_mara.errors import GymMaraError, short
from gym_mara.extras import needs

with needs("a data set of Minari", "minari"):
    import h5py  # noqa: F401 - Minari imports it when it writes
    import minari
    from minari.data_collector.episode_buffer import EpisodeBuffer
    from minari.dataset.minari_dataset import parse_dataset_id
    from minari.dataset.minari_storage import MinariStorage


_ROOM = 1 << 20
"""What must be left of a disk beside the arrays of an episode, bytes."""


class MinariWriter(Writer):
    """Writes the folder of a data set of Minari, in HDF5, one episode after the other.

    `minari.load_dataset` looks for it by its name, in the folder that the environment variable MINARI_DATASETS_PATH names.

    Raises:
        GymMaraError: the name is none that Minari knows.
    """

    def __init__(self, folder: Path, name: str, contents: Contents) -> None:
        try:
            parse_dataset_id(name)
        except (TypeError, ValueError):  # TypeError: there is no version
            raise GymMaraError(
                f"Minari names a data set as its folder, and {short(name)} is no name for one: it must have letters, digits, _ "
                "and -, and end with a version, such as reach-v0"
            ) from None
        spaces = contents.observation_space, contents.action_space
        self._folder = folder
        _find_room(folder, 0)
        self._storage = MinariStorage.new(folder / "data", *spaces, env_spec=contents.spec)
        self._about = {
            "dataset_id": name,
            "algorithm_name": contents.policy,
            "description": f"Episodes of {contents.spec.id} with {contents.robot}; {contents.policy} acted.",
            "minari_version": minari.__version__,
        }

    def add(self, episode: Episode) -> None:
        infos = None
        if episode.success is not None:  # Minari's infos begin with that of the reset
            infos = {"success": np.concatenate([[False], episode.success])}
        buffer: dict[str, Any] = {
            "seed": episode.seed,
            "observations": episode.observations,
            "actions": episode.actions,
            "rewards": episode.rewards,
            "terminations": episode.terminated,
            "truncations": episode.truncated,
            "infos": infos,
        }
        _find_room(self._folder, sum(a.nbytes for a in _leaves(buffer)))
        try:
            self._storage.update_episodes([EpisodeBuffer(**buffer)])
        except RuntimeError as error:  # h5py, which cannot close the file
            raise OSError(str(error)) from error

    def finish(self) -> None:
        self._storage.update_metadata(self._about)


def _find_room(folder: Path, size: int) -> None:
    """Raise the OSError of a full disk before HDF5 meets it, which ends the process with a segmentation fault.

    Args:
        folder: on the disk.
        size: of the arrays that HDF5 will write, bytes.
    """
    with tempfile.TemporaryFile(dir=folder, buffering=0) as room:
        for _ in range(0, size + _ROOM, _ROOM):
            if room.write(bytes(_ROOM)) < _ROOM:  # what is left of the disk is less
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def _leaves(values: Any) -> Iterator[NDArray[Any]]:
    """The arrays in nested dictionaries."""
    if isinstance(values, dict):
        for value in values.values():
            yield from _leaves(value)
    elif isinstance(values, np.ndarray):
        yield values
