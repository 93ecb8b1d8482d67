"""Where mesh files are looked for, and what is said about one that is not found."""

from __future__ import annotations

from pathlib import Path

import pytest

from gym_mara.errors import GymMaraError
from gym_mara.robot.description.meshes.files import folder_findings, mesh_file


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


# Packages and folders of other names.


def _two_packages(folder: Path) -> tuple[str, str]:
    """Two packages with a mesh of the same path; returns their folders."""
    for name in ("a", "b"):
        _file(folder / name / "meshes" / "link.stl")
    return str(folder / "a"), str(folder / "b")


@pytest.mark.parametrize("package", ["a", "b"])
def test_of_two_packages_the_one_of_that_name_counts(tmp_path: Path, package: str) -> None:
    folders, name = _two_packages(tmp_path / "ws"), f"package://{package}/meshes/link.stl"
    for given in (folders, folders[::-1]):
        found = mesh_file(tmp_path / "arm.urdf", name, given)
        assert found == tmp_path / "ws" / package / "meshes" / "link.stl"
        assert folder_findings(tmp_path / "arm.urdf", [name], given) == []


def test_a_package_may_be_named_by_its_package_xml(tmp_path: Path) -> None:
    folders = _two_packages(tmp_path / "ws")
    (tmp_path / "ws" / "b" / "package.xml").write_text("<package><name>arm</name></package>")
    name = "package://arm/meshes/link.stl"
    assert mesh_file(tmp_path / "arm.urdf", name, folders).parents[1].name == "b"
    assert folder_findings(tmp_path / "arm.urdf", [name], folders) == []


def test_a_folder_of_another_name_counts_if_it_is_the_only_one_with_a_note(tmp_path: Path) -> None:
    folders, name = _two_packages(tmp_path / "ws"), "package://arm/meshes/link.stl"
    with pytest.raises(GymMaraError, match=r"but in 2 others: .*Keep one in package_dirs"):
        mesh_file(tmp_path / "arm.urdf", name, folders)
    for given in ([folders[0]], [folders[0], folders[0]]):
        assert mesh_file(tmp_path / "arm.urdf", name, given).parents[1].name == "a"
        (note,) = folder_findings(tmp_path / "arm.urdf", [name], given)
        assert (note.severity, note.part) == ("note", "package 'arm'")
        assert repr(folders[0]) in note.message


def test_a_path_beside_the_urdf_counts_before_package_dirs(tmp_path: Path) -> None:
    folders = _two_packages(tmp_path / "ws")
    for name, first in ("meshes/link.stl", tmp_path), ("meshes/other.stl", tmp_path / "ws" / "a"):
        there = _file(first / name)
        assert mesh_file(tmp_path / "arm.urdf", name, folders) == there
