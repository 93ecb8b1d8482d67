"""What a scenario of the soak has done, what was wrong, and what the processes use."""

from __future__ import annotations

import ctypes
import gc
import pickle
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
import psutil

from gym_mara.rendering.drawing import free

DONE = ("steps", "comparisons", "pictures", "files", "stops")
"""What is counted. A stop is one of the safety filter, because a message was late: on a busy machine no fault."""
WRONG = ("NaN", "outside the space", "other result", "black picture", "left files", "no answer")
"""What is counted and must not happen."""


_NO_RENDERER = -1
"""A key that no renderer has."""
_libc = ctypes.CDLL(None)


class _MallInfo(ctypes.Structure):
    """glibc's struct mallinfo2."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    )


_libc.mallinfo2.restype = _MallInfo


@dataclass
class Tally:
    """What one scenario has done, and what was wrong."""

    done: Counter[str] = field(default_factory=Counter)
    wrong: Counter[str] = field(default_factory=Counter)
    _counting: threading.Lock = field(default_factory=threading.Lock)

    def observe(self, space: gymnasium.Space[Any], observation: Any, reward: Any) -> None:
        """Count a step, NaN, and observations outside their space."""
        finite = all(np.isfinite(part).all() for part in (*_arrays(observation), reward))
        inside = space.contains(observation)
        with self._counting:  # three threads count
            self.done["steps"] += int(np.size(reward))
            self.wrong["NaN"] += int(not finite)
            self.wrong["outside the space"] += int(not inside)

    def compare(self, first: Any, again: Any) -> None:
        """Count a comparison of two results that must be equal."""
        self.done["comparisons"] += 1
        self.wrong["other result"] += int(pickle.dumps(first) != pickle.dumps(again))


def _arrays(observation: Any) -> Iterator[Any]:
    """The arrays of an observation."""
    if isinstance(observation, dict):
        for part in observation.values():
            yield from _arrays(part)
    else:
        yield observation


Scenario = Callable[[int, Tally], None]
"""One round of a scenario, called with a seed."""


@dataclass(frozen=True)
class Usage:
    """What this process and its children use."""

    memory: int
    """Memory of this process: what is resident, but of the allocator's heap only what is allocated, bytes. What is free between blocks
    stays resident, and grows for hours without a leak."""
    memory_of_children: int
    """Resident memory of its children, bytes: of the simulated arm."""
    resident_memory: int
    """Resident memory of this process, bytes."""
    threads: int
    files: int
    processes: int

    @classmethod
    def now(cls) -> Usage:
        """After a garbage collection."""
        gc.collect()
        free(_NO_RENDERER, wait=True)  # the drawing thread has freed what was collected
        _libc.malloc_trim(0)
        process = psutil.Process()
        resident = process.memory_info().rss
        heap = sum(each.rss for each in process.memory_maps() if each.path == "[heap]")
        children = process.children(recursive=True)
        family = [process, *children]
        return cls(
            resident - heap + _libc.mallinfo2().uordblks,
            sum(one.memory_info().rss for one in children),
            resident,
            sum(one.num_threads() for one in family),
            sum(one.num_fds() for one in family),
            len(family),
        )
