"""Where mesh files are looked for, and what is said about one that is not found."""

from __future__ import annotations

from pathlib import Path

import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot.description.meshes.files import mesh_file


def _file(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch()
    return path


@pytest.mark.parametrize("name", ["package://arm/link.stl", "meshes/link.stl", "gone.stl"])
def test_a_missing_file_may_be_in_package_dirs(tmp_path: Path, name: str) -> None:
    with pytest.raises(GymMaraError, match=r"arm\.urdf.*is not found; .*[Gg]ive package_dirs="):
        mesh_file(tmp_path / "arm.urdf", name, ())


@pytest.mark.parametrize("name", ["file:///root/gone/link.stl", "/root/gone/link.stl"])
def test_a_path_of_another_machine_must_be_changed(tmp_path: Path, name: str) -> None:
    with pytest.raises(GymMaraError, match="another machine must be changed") as raised:
        mesh_file(tmp_path / "arm.urdf", name, ())
    assert "package_dirs" not in str(raised.value)


@pytest.mark.parametrize("name", ["package://arm/meshes/link.stl", "arm/meshes/link.stl"])
def test_another_letter_case_is_named(tmp_path: Path, name: str) -> None:
    there = _file(tmp_path / "arm" / "Meshes" / "link.STL")
    if (tmp_path / "arm" / "meshes").exists():  # the file system ignores the letter case
        assert mesh_file(tmp_path / "arm.urdf", name, ()).samefile(there)
        return
    with pytest.raises(GymMaraError, match=r"There is .* the same letter case") as raised:
        mesh_file(tmp_path / "arm.urdf", name, ())
    assert str(there) in str(raised.value)


def test_windows_separators_are_named(tmp_path: Path) -> None:
    _file(tmp_path / "meshes" / "link.stl")
    with pytest.raises(GymMaraError, match="Write '/' between folders"):
        mesh_file(tmp_path / "arm.urdf", "meshes\\link.stl", ())


def test_a_package_without_the_file_is_named(tmp_path: Path) -> None:
    there = _file(tmp_path / "arm" / "meshes" / "other.stl").parents[1]
    for name in ("package://arm/meshes/link.stl", "package://arm/link.stl"):
        with pytest.raises(GymMaraError, match="without this file: add the file") as raised:
            mesh_file(tmp_path / "arm.urdf", name, ())
        assert repr(str(there)) in str(raised.value)
