"""The libraries of gym_mara and of each extra: the oldest version that is allowed, and the one that is installed here.

    python benchmarks/versions.py

The rows come from pyproject.toml, through the metadata of the installed package; docs/versions.md has its output, and what the
oldest versions were tried with.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from importlib.metadata import PackageNotFoundError, requires, version

from packaging.requirements import Requirement

_BOUNDS = (">=", "==")


def rows() -> list[tuple[str, str, str, str]]:
    """A row for each library: its name, the extras that need it, its lowest version, and the one that is installed."""
    extras: defaultdict[str, list[str]] = defaultdict(list)
    lowest: dict[str, str] = {}
    for text in requires("gym_mara") or []:
        required = Requirement(text)
        if required.name == "gym_mara":  # an extra of other extras
            continue
        marker = str(required.marker or "")
        extras[required.name].append(marker.rpartition('extra == "')[2].rstrip('"') or "-")
        bounds = [each.version for each in required.specifier if each.operator in _BOUNDS]
        lowest.setdefault(required.name, bounds[0] if bounds else "-")
    return [
        (name, ", ".join(dict.fromkeys(extras[name])), lowest[name], _installed(name))
        for name in sorted(extras, key=lambda name: (extras[name] != ["-"], name.lower()))
    ]


def _installed(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return "-"


def main() -> None:
    """Print the table."""
    print(f"Python {sys.version.split()[0]}, gym_mara {version('gym_mara')}\n")
    print("| library | extras | oldest | installed |\n|---|---|---|---|")
    for row in rows():
        print(f"| {' | '.join(row)} |")


if __name__ == "__main__":
    main()
