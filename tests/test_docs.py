"""The documentation: its links, the length of the README, and the README's example."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PAGES = [README, ROOT / "CONTRIBUTING.md", *DOCS]
LONGEST_README = 120


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_points_to_a_file_and_a_heading_that_exist(page: Path) -> None:
    for link, file, anchor in _links(page):
        assert file.exists(), f"{link}: there is no file {file}"
        assert not anchor or anchor in _anchors(file), f"{link}: there is no heading {anchor!r}"


def test_the_readme_is_short() -> None:
    assert len(README.read_text().splitlines()) <= LONGEST_README


def test_every_page_under_docs_is_linked_from_another_page() -> None:
    linked = {file for page in PAGES for _, file, _ in _links(page) if file != page}
    assert [page for page in DOCS if page not in linked] == []


def test_the_example_of_the_readme_runs(tmp_path: Path) -> None:
    [example] = re.findall(r"^```python\n(.*?)^```", README.read_text(), re.M | re.S)
    done = subprocess.run(
        [sys.executable, "-c", example],
        check=False,
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "distance to the target: 0.0" in done.stdout
    assert (tmp_path / "mara.png").stat().st_size > 0


def _links(page: Path) -> list[tuple[str, Path, str]]:
    """The relative links of a page: as written, the file, and the anchor ("" without one)."""
    links = []
    for link in re.findall(r"\]\(([^)\s]+)\)", _without_blocks(page.read_text())):
        if re.match(r"[a-z]+:", link):
            continue  # another site
        name, _, anchor = link.partition("#")
        links.append((link, (page.parent / name).resolve() if name else page, anchor))
    return links


def _anchors(page: Path) -> set[str]:
    """The anchors of a page's headings, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", _without_blocks(page.read_text()), re.M)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def _without_blocks(text: str) -> str:
    return re.sub(r"^ *```.*?^ *```", "", text, flags=re.M | re.S)
