"""The Python blocks of the pages: each is run, or with a reason in the page only compiled."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import pytest

from gym_mara.robot import catalog
from tests.pages.blocks import PAGES, ROOT, Block, blocks

RUN_ELSEWHERE = {
    "README.md": "test_docs.py",
    "docs/add_a_backend.md": "test_examples.py",
    "docs/add_a_task.md": "tasks/test_registry.py",
    "docs/deploy.md": "deploy/test_policy.py",
    "docs/training.md": "test_docs.py",
}
"""Pages whose blocks have a test of their own, which knows what they should do; these blocks are only compiled here."""


def python(page: str) -> list[Block]:
    """The Python blocks of a page."""
    return [block for block in blocks(page) if block.language == "python"]


COMPILE_KERNELS = ["docs/backends.md"]
"""Pages with Warp's kernels, whose compilation takes long."""
RUN = [
    pytest.param(page, marks=pytest.mark.slow if page in COMPILE_KERNELS else ())
    for page in PAGES
    if page not in RUN_ELSEWHERE and any(not block.parsed_only for block in python(page))
]


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("page", RUN)
def test_the_blocks_of_a_page_run_one_after_the_other(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    if page in PREPARED:
        PREPARED[page](tmp_path, monkeypatch)
    script: dict[str, object] = {"__name__": "page", "__file__": str(tmp_path / "page.py")}
    for block in python(page):
        if not block.parsed_only:
            exec(compile("\n" * block.line + block.text, page, "exec"), script)


@pytest.mark.parametrize("page", [page for page in PAGES if python(page)])
def test_every_block_compiles_and_imports_what_there_is(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for block in python(page):
        tree = ast.parse(block.text)
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        for place, name in [
            (node.module or "", alias.name) for node in imports for alias in node.names
        ]:
            if place.startswith("gym_mara."):
                there = hasattr(importlib.import_module(place), name) or find_spec(
                    f"{place}.{name}"
                )
                assert there or f"/{name}.py" in text, f"{page}: {place} has no {name}"


@pytest.mark.parametrize(("page", "test"), RUN_ELSEWHERE.items())
def test_a_page_that_is_run_elsewhere_is_named_there(page: str, test: str) -> None:
    assert Path(page).name in (ROOT / "tests" / test).read_text(encoding="utf-8")


def _trio(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Write the robot of the page, and register it as if its folder were in robots/."""
    urdf, srdf, target = (
        b.text for b in blocks("docs/add_a_robot.md") if b.language in ("xml", "json")
    )
    for name, text in (("urdf", urdf), ("srdf", srdf), ("target.json", target)):
        (folder / f"trio.{name}").write_text(text)
    robots = catalog.own_robots()
    robots["trio"] = catalog.RobotFiles(folder / "trio.urdf", folder / "trio.srdf")
    monkeypatch.setattr(catalog, "own_robots", lambda: robots)


PREPARED: dict[str, Callable[[Path, pytest.MonkeyPatch], None]] = {"docs/add_a_robot.md": _trio}
"""What a page needs before its blocks run."""
