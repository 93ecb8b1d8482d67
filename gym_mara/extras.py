"""Imports of optional libraries, with an error that names a missing library and the extra that installs it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement

from gym_mara.errors import MissingExtraError


@contextmanager
def needs(part: str, extra: str, *libraries: str) -> Iterator[None]:
    """Check the versions of optional libraries, then import them in the `with` block.

    Args:
        part: the part of gym_mara that needs the libraries; error messages begin with it.
        extra: the extra of gym_mara that installs the libraries and defines their versions.
        libraries: the libraries of the extra that the part needs; all of them if none is given.

    Raises:
        MissingExtraError: a library is not installed, is too old, or cannot be imported.
    """
    requirements = [r for r in _requirements(extra) if not libraries or r.name in libraries]
    for requirement in requirements:
        library = f"{requirement.name}{requirement.specifier}"
        try:
            installed = version(requirement.name)
        except PackageNotFoundError:
            raise MissingExtraError(part, library, extra) from None
        if not requirement.specifier.contains(installed, prereleases=True):
            raise MissingExtraError(part, library, extra, f"and {installed} is installed")
    try:
        yield
    except MissingExtraError:
        raise
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("gym_mara"):
            raise
        raise MissingExtraError(part, error.name or str(error), extra) from error
    except ImportError as error:
        names = " and ".join(libraries or [r.name for r in requirements]) or error.name or extra
        raise MissingExtraError(
            part, names, extra, f"which cannot be imported ({error})"
        ) from error


def _requirements(extra: str) -> list[Requirement]:
    """The requirements of an extra, from the metadata of the installed gym_mara; none if it is not installed."""
    try:
        texts = requires("gym_mara") or []
    except PackageNotFoundError:
        return []
    requirements = [Requirement(text) for text in texts]
    return [r for r in requirements if r.marker and r.marker.evaluate({"extra": extra})]
