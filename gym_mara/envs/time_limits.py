"""The step counts of Gymnasium's TimeLimit wrappers, which are part of a snapshot."""

from __future__ import annotations

import sys
import weakref
from collections.abc import Sequence
from typing import Any

import gymnasium
from gymnasium.wrappers import TimeLimit

_RESET = TimeLimit.reset.__code__


class TimeLimits:
    """The TimeLimit wrappers around an environment, which it does not own.

    Args:
        wrappers: the wrappers.
    """

    def __init__(self, wrappers: Sequence[Any] = ()) -> None:
        self._wrappers = [weakref.ref(wrapper) for wrapper in wrappers]

    def note_reset(self, env: gymnasium.Env[Any, Any]) -> None:
        """Note the wrappers whose reset calls the reset of this environment.

        Gymnasium does not tell an environment its wrappers. At a reset they are in the call stack, which is read in a few
        microseconds. gc.get_referrers, the other way to find them, looks at every object of the program.
        """
        found, frame = [], sys._getframe(1)
        while frame is not None:
            if frame.f_code is _RESET and frame.f_locals["self"].unwrapped is env:
                found.append(frame.f_locals["self"])
            frame = frame.f_back  # type: ignore[assignment]
        if found:
            self._wrappers = [weakref.ref(wrapper) for wrapper in found]

    def counts(self) -> list[int]:
        """The step counts of the wrappers, from the inside to the outside."""
        return [wrapper._elapsed_steps for wrapper in self._living()]

    def restore(self, counts: Sequence[int], steps: int) -> None:
        """Set the step counts of the wrappers.

        Args:
            counts: what `counts` returned.
            steps: the steps of the episode, for all wrappers if `counts` is of other wrappers.
        """
        wrappers = self._living()
        if len(counts) != len(wrappers):
            counts = [steps] * len(wrappers)
        for wrapper, count in zip(wrappers, counts, strict=True):
            wrapper._elapsed_steps = count

    def _living(self) -> list[Any]:
        return [wrapper for reference in self._wrappers if (wrapper := reference()) is not None]

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy of the wrapped environment then refers to its own wrappers.
        return TimeLimits, (self._living(),)
