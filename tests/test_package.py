"""The package: that its wheel has every folder and the pretrained policies, and how it is cited."""

from __future__ import annotations

import re
import runpy
from pathlib import Path

from packaging.version import Version

import gym_mara
from gym_mara.robot.catalog import own_robots

ROOT = Path(__file__).resolve().parents[1]


def test_the_wheel_has_every_folder_with_modules() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    listed = re.findall(r'"([\w.]+)"', text.split("packages = [")[1].split("]")[0])
    folders = {file.parent.relative_to(ROOT) for file in (ROOT / "gym_mara").rglob("*.py")}
    robots = ["gym_mara.robots", *(f"gym_mara.robots.{name}" for name in own_robots())]
    assert sorted(listed) == sorted([".".join(f.parts) for f in folders] + robots)


def test_the_wheel_has_every_pretrained_policy() -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    assert '"gym_mara.pretrained" = ["*.onnx"]' in text.split("[tool.setuptools.package-data]")[1]
    folder = ROOT / "gym_mara" / "pretrained"
    others = [f.name for f in folder.iterdir() if f.suffix != ".onnx" and f.is_file()]
    assert others == ["__init__.py"]


def test_the_citation_names_the_package_as_it_is() -> None:
    about = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    for field, line in {
        "name": "title: {}",
        "description": "abstract: {}",
        "license": "license: {}",
    }.items():
        value = re.findall(f'^{field} = "(.*)"$', about, re.M)[0]
        assert line.format(value) in citation.splitlines()
    assert f"version: {gym_mara.__version__}" in citation.splitlines()
    assert f'version = "{gym_mara.__version__}"' in about.splitlines()
    [author] = re.findall(r'authors = \[\{ name = "(.*)" \}\]', about)
    assert f"  - name: {author}" in citation.splitlines()


def test_every_library_has_a_lowest_version_that_is_not_above_the_installed_one() -> None:
    rows = runpy.run_path(str(ROOT / "benchmarks" / "versions.py"))["rows"]
    table = {name: (lowest, installed) for name, _, lowest, installed in rows()}
    assert {"numpy", "gymnasium", "torch", "stable-baselines3"} <= table.keys()
    assert not [name for name, (lowest, _) in table.items() if lowest == "-"]
    found = {name: each for name, each in table.items() if each[1] != "-"}
    assert [name for name, (low, now) in found.items() if Version(now) < Version(low)] == []


def test_the_page_of_versions_has_every_library_of_pyproject() -> None:
    rows = runpy.run_path(str(ROOT / "benchmarks" / "versions.py"))["rows"]
    page = (ROOT / "docs" / "versions.md").read_text(encoding="utf-8").partition("## The table")[2]
    listed = re.findall(r"^\| ([\w-]+) \| ([\w, -]+) \| ([\w.]+) \| \S+ \|$", page, re.M)[1:]
    assert listed == [tuple(row[:3]) for row in rows()]
