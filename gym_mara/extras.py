"""Optional libraries: named, with the version wanted, where one is absent or too old."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement

from gym_mara.errors import MissingExtraError


@contextmanager
def needs(part: str, extra: str, *libraries: str) -> Iterator[None]:
    """Import what a part of gym_mara needs of an extra.

    Args:
        part: what needs it, as an error begins.
        extra: the extra, which says in which versions.
        libraries: those of the extra that the part needs; all of them where none is named.

    Raises:
        MissingExtraError: a library is absent, too old, or cannot be imported.
    """
    wanted_ones = [r for r in _requirements(extra) if not libraries or r.name in libraries]
    for wanted in wanted_ones:
        named = f"{wanted.name}{wanted.specifier}"
        try:
            found = version(wanted.name)
        except PackageNotFoundError:
            raise MissingExtraError(part, named, extra) from None
        if not wanted.specifier.contains(found, prereleases=True):
            raise MissingExtraError(part, named, extra, f"and {found} is installed")
    try:
        yield
    except MissingExtraError:
        raise
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("gym_mara"):
            raise
        raise MissingExtraError(part, error.name or str(error), extra) from error
    except ImportError as error:
        names = " and ".join(libraries or [r.name for r in wanted_ones]) or error.name or extra
        raise MissingExtraError(
            part, names, extra, f"which cannot be imported ({error})"
        ) from error


def _requirements(extra: str) -> list[Requirement]:
    """What an extra asks for, as gym_mara was installed; nothing is known where it was not."""
    try:
        texts = requires("gym_mara") or []
    except PackageNotFoundError:
        return []
    wanted = [Requirement(text) for text in texts]
    return [r for r in wanted if r.marker and r.marker.evaluate({"extra": extra})]
