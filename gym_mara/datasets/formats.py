"""The formats of data sets, and what writes one."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from gym_mara.datasets.contents import Contents
from gym_mara.datasets.episode import Episode
from gym_mara.errors import one_of

FORMATS = ("minari", "lerobot")


class Writer(ABC):
    """Writes a data set.

    Args:
        folder: an empty folder, which gets another name when the data set is complete.
        name: the name that the folder gets.
        contents: what the episodes have in common.

    Raises:
        GymMaraError: the format cannot store this data set.
    """

    @abstractmethod
    def __init__(self, folder: Path, name: str, contents: Contents) -> None: ...

    @abstractmethod
    def add(self, episode: Episode) -> None:
        """Write an episode. An OSError says that it cannot be written, such as to a full disk."""

    @abstractmethod
    def finish(self) -> None:
        """Complete the data set, of at least one episode. Errors are those of `add`."""

    def close(self) -> None:  # noqa: B027 - some writers hold nothing
        """Free what is held, also after an error. No other method is called afterwards."""


def writer_class(name: str) -> type[Writer]:
    """What writes data sets of a format.

    Raises:
        GymMaraError: there is no such format.
        MissingExtraError: its libraries are not installed.
    """
    if one_of("format", name, FORMATS) == "minari":
        from gym_mara.datasets.minari import MinariWriter

        return MinariWriter
    from gym_mara.datasets.lerobot import LeRobotWriter

    return LeRobotWriter
