"""Where the mesh files of a URDF are."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from gym_mara.errors import GymMaraError
from gym_mara.files import LARGEST_TEXT, read_bytes
from gym_mara.robot.diagnosis import Finding

_SHOWN = 6
"""The number of places that an error names."""
LARGEST_MESHES = 2**30
"""The size of all mesh files of a robot together, bytes."""


def mesh_file(urdf: Path, name: str, package_dirs: Sequence[str]) -> Path:
    """The file that a mesh's name means: an absolute path, file://…, package://… or a path beside the URDF.

    The package of package://PACKAGE/PATH is a folder of that name in `package_dirs`, in a folder above the URDF, or along
    ROS_PACKAGE_PATH or AMENT_PREFIX_PATH; or `package_dirs` has the folder itself, called PACKAGE there or in its package.xml. A
    folder of `package_dirs` with another name counts if the file is nowhere else.

    Raises:
        GymMaraError: there is no such file, or only several in folders with other names.
    """
    places = candidates(urdf, name, package_dirs)
    if there := [place for place in places if os.path.lexists(place)]:
        others = {os.path.realpath(place) for place in there}
        if len(others) > 1 and there[0] in _in_other_folders(name, package_dirs):
            raise GymMaraError(
                f"the mesh {name!r} of {str(urdf)!r} is in no folder of its package's name, but in {len(others)} others: "
                f"{', '.join(map(str, there[:_SHOWN]))}. Keep one in package_dirs, or rename the package's folder"
            )
        return there[0]
    shown = [str(place) for place in places[:_SHOWN]]
    rest = f" and {len(places) - _SHOWN} more places" if len(places) > _SHOWN else ""
    raise GymMaraError(
        f"the mesh {name!r} of {str(urdf)!r} is not found; it was looked for at {', '.join(shown)}{rest}. "
        f"{_advice(name, places)}"
    )


def candidates(urdf: Path, name: str, package_dirs: Sequence[str]) -> list[Path]:
    """The places where a mesh may be, the first one first."""
    _, _, rest = name.rpartition("://")
    own = urdf.absolute().parent
    if _is_absolute(name):
        return [Path(rest)]
    given = [Path(folder).absolute() for folder in package_dirs]
    ros = [
        Path(folder) / below
        for variable, below in (("ROS_PACKAGE_PATH", ""), ("AMENT_PREFIX_PATH", "share"))
        for folder in os.environ.get(variable, "").split(os.pathsep)
        if folder
    ]
    if "://" not in name:
        folders = [own, *given, *own.parents, *ros]
        return list(dict.fromkeys(folder / rest for folder in folders))
    package, _, inside = rest.partition("/")
    places = [folder / rest for folder in given]
    places += [folder / inside for folder in given if _is_package(folder, package)]
    places += [folder / rest for folder in (own, *own.parents, *ros)]
    return list(dict.fromkeys([*places, *_in_other_folders(name, package_dirs)]))


def folder_findings(urdf: Path, names: Iterable[str], package_dirs: Sequence[str]) -> list[Finding]:
    """The findings about packages of meshes of these names that are only in folders with other names."""
    found = {}
    for name in names:
        places = candidates(urdf, name, package_dirs)
        first = next((place for place in places if os.path.lexists(place)), None)
        if first in _in_other_folders(name, package_dirs):
            package, _, inside = name.rpartition("://")[2].partition("/")
            found[package] = first.parents[len(Path(inside).parts) - 1]
    return [
        Finding(
            "note",
            f"package {package!r}",
            f"its meshes are read from {str(folder)!r}, which has another name",
            "they may be those of another package",
            "Nothing is to do if they are right; else give package_dirs the package's folder",
        )
        for package, folder in found.items()
    ]


def _in_other_folders(name: str, package_dirs: Sequence[str]) -> list[Path]:
    """The places of package://PACKAGE/PATH in folders of `package_dirs` that are not called PACKAGE."""
    package, _, inside = name.rpartition("://")[2].partition("/")
    if "://" not in name or _is_absolute(name) or not inside:
        return []
    folders = [Path(folder).absolute() for folder in package_dirs]
    return [folder / inside for folder in folders if not _is_package(folder, package)]


def _is_package(folder: Path, package: str) -> bool:
    """Whether a folder is the package of this name, by its own name or by that in its package.xml."""
    if folder.name == package:
        return True
    about = folder / "package.xml"
    if not about.is_file():
        return False
    named = re.search(rb"<name>\s*([^<\s]+)\s*</name>", read_bytes(about, LARGEST_TEXT))
    return named is not None and named[1].decode("utf-8", "replace") == package


def _is_absolute(name: str) -> bool:
    scheme, _, rest = name.rpartition("://")
    return scheme == "file" or (not scheme and Path(rest).is_absolute())


def _advice(name: str, places: Sequence[Path]) -> str:
    """What to do about a mesh that is at none of these places."""
    for place in places:
        if similar := _in_other_case(place):
            return f"There is {str(similar)!r}: write its name in the same letter case"
    if "\\" in name:
        return "Write '/' between folders, not '\\'"
    if _is_absolute(name):
        return "A path of another machine must be changed in the URDF, to package://PACKAGE/PATH or a path beside the URDF"
    if "://" not in name:
        return (
            "Put the file there, or give package_dirs=[…] the folder to which its path is relative"
        )
    if packages := _packages(name, places):
        return f"The package is in {', '.join(map(repr, packages))}, without this file: add the file, or correct its name"
    return "Give package_dirs=[…] the folder that holds the package, or set ROS_PACKAGE_PATH"


def _packages(name: str, places: Sequence[Path]) -> list[str]:
    """The folders of the package of package://PACKAGE/PATH that exist."""
    _, _, rest = name.rpartition("://")
    package, inside = rest.partition("/")[::2]
    depth = len(Path(inside).parts)
    found = {str(place.parents[depth - 1]) for place in places if "://" in name and depth}
    return sorted(
        folder for folder in found if Path(folder).name == package and Path(folder).is_dir()
    )


def _in_other_case(place: Path) -> Path | None:
    """The file whose path differs by its letter case only."""
    found = Path(place.anchor)
    for part in place.parts[1:]:
        if not os.path.lexists(found / part):
            try:
                names = os.listdir(found)
            except OSError:
                return None
            same = (name for name in names if name.lower() == part.lower())
            if (other := next(same, None)) is None:
                return None
            part = other
        found /= part
    return found
