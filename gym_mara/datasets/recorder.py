"""Records episodes as a data set: a whole one, or none."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

from gym_mara.datasets.contents import Contents
from gym_mara.datasets.episode import Episode
from gym_mara.datasets.formats import Writer, writer_class
from gym_mara.files import folder_written_aside, writing

MOST_EPISODES = 100_000
"""The most episodes of a data set."""


@dataclass
class Recorded:
    """What a data set holds."""

    episodes: int = 0
    steps: int = 0
    successes: int | None = None
    """How many episodes end in success; None if the task has no tolerances of success."""

    def count(self, episode: Episode) -> None:
        """Count an episode."""
        self.episodes += 1
        self.steps += len(episode.rewards)
        if episode.success is not None:
            self.successes = (self.successes or 0) + int(episode.success[-1])


@contextmanager
def recorder(
    form: str, folder: Path, contents: Contents
) -> Iterator[tuple[Callable[[Episode], None], Recorded]]:
    """Yield what writes an episode into a new data set, and its counts. The folder appears if the block succeeds.

    Args:
        form: one of FORMATS.
        folder: a new folder.
        contents: what the episodes have in common.

    Raises:
        GymMaraError: the folder exists or cannot be written, the disk is full, or the format cannot store this; then nothing
            is left.
        MissingExtraError: a library is not installed.
    """
    write, recorded = writer_class(form), Recorded()
    with folder_written_aside(folder) as aside:
        with writing(folder):
            writer: Writer = write(aside.absolute(), folder.name, contents)
        with closing(writer):

            def add(episode: Episode) -> None:
                with writing(folder):
                    writer.add(episode)
                recorded.count(episode)

            yield add, recorded
            with writing(folder):
                writer.finish()
