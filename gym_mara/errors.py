"""The errors a user can mend: each says what was wrong, what is allowed and what to do."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class GymMaraError(ValueError):
    """Wrong input to gym_mara."""


class MissingExtraError(GymMaraError, ImportError):
    """A library that an optional part needs is not installed."""

    def __init__(self, part: str, library: str, extra: str) -> None:
        super().__init__(
            f"{part} needs {library}, which is not installed: pip install 'gym_mara[{extra}]'"
        )
        self.part, self.library, self.extra = part, library, extra

    def __reduce__(self) -> tuple[type[MissingExtraError], tuple[str, str, str]]:
        return type(self), (self.part, self.library, self.extra)


def unknown(kind: str, name: object, valid: Iterable[str]) -> GymMaraError:
    """An error for a name that is not among the valid ones, with the nearest of them."""
    names = sorted(valid)
    near = difflib.get_close_matches(str(name), names, n=1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return GymMaraError(f"unknown {kind} {name!r}.{hint} Valid: {', '.join(names)}.")
