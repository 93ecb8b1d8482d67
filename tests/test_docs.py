"""The documentation: its links, the length of the README, and the README's example."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
DOCS = sorted(p for p in (ROOT / "docs").rglob("*.md") if "_build" not in p.parts)
PAGES = [README, ROOT / "CONTRIBUTING.md", *DOCS]
LONGEST_README = 120
INDEX = ROOT / "docs" / "index.md"
TEXTS = [
    *PAGES,
    ROOT / "CHANGELOG.md",
    *(ROOT / "robots").rglob("*.md"),
    *(
        path
        for folder in ("gym_mara", "examples", "benchmarks")
        for path in (ROOT / folder).rglob("*")
        if path.suffix in (".py", ".j2", ".md")
    ),
]
MISREAD = (
    "one that was cut off is gone on with",
    "on seeds that no result is reported of",
    "what was trained on teleports says where to go",
    "links that collide in red, also where the arm has been put back since",
    "any other reach task goes by `task=",
    "who can reach the viewer's port can move the arm",
    "so many run at a time as the cluster has cores",
    "faces are joined end to end or side to side",
    "a motor is mounted the way round that fits",
    "need two lines changed",
)
"""Sentences that readers had to read twice, or that were not true."""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_relative_link_points_to_a_file_and_a_heading_that_exist(page: Path) -> None:
    for link, file, anchor in _links(page):
        assert file.exists(), f"{link}: there is no file {file}"
        assert not anchor or anchor in _anchors(file), f"{link}: there is no heading {anchor!r}"


def test_the_readme_is_short() -> None:
    assert len(README.read_text().splitlines()) <= LONGEST_README


def test_every_page_under_docs_is_linked_from_another_page() -> None:
    linked = {file for page in PAGES for _, file, _ in _links(page) if file != page}
    listed = re.findall(r"^(?:.* <)?([\w/-]+)>?$", INDEX.read_text(), re.M)  # in its toctrees
    linked |= {ROOT / "docs" / f"{name}.md" for name in listed}
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


def test_no_text_has_a_sentence_that_is_read_twice() -> None:
    texts = {path: " ".join(path.read_text(encoding="utf-8").lower().split()) for path in TEXTS}
    assert len(texts) > 150
    assert [(p, s) for p, text in texts.items() for s in MISREAD if s in text] == []


def test_the_readme_says_beside_make_vec_how_stable_baselines3_takes_it() -> None:
    lines = README.read_text(encoding="utf-8").splitlines()
    [place] = [number for number, line in enumerate(lines) if "gymnasium.make_vec(" in line]
    assert "MaraVecEnv" in "".join(lines[place : place + 2])


def test_the_page_on_backends_shows_the_example_package() -> None:
    page = (ROOT / "docs" / "add_a_backend.md").read_text(encoding="utf-8")
    package = ROOT / "examples" / "lag_backend"
    blocks = re.findall(r"^```(?:python|toml)\n(.*?)^```", page, re.M | re.S)
    assert (package / "gym_mara_lag.py").read_text(encoding="utf-8") in blocks
    assert (package / "pyproject.toml").read_text(encoding="utf-8") in blocks
    [contract] = [block for block in blocks if "BackendContract" in block]
    tests = (package / "test_gym_mara_lag.py").read_text(encoding="utf-8")
    assert contract[contract.index("THREE_JOINTS") :].rstrip() in tests


def test_each_side_of_the_film_of_both_backends_has_its_name() -> None:
    with Image.open(ROOT / "docs" / "media" / "both_backends.gif") as film:
        picture = np.asarray(film.convert("L"))
    height, width = picture.shape
    for left in (0, width // 2):
        corner = picture[: height // 10, left : left + width // 8]
        assert (corner < 100).sum() > 50, "dark letters"


@pytest.mark.slow
def test_the_scripts_of_the_page_on_training_run(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "training.md").read_text(encoding="utf-8")
    scripts = re.findall(r"^```python\n(.*?)^```", page, re.M | re.S)
    for name in ("preset_agent", "ACKTR", "load_policy", "MaraVecEnv"):
        assert any(name in script for script in scripts)
    code = "\n".join(scripts)
    for steps in ("100_000", "40_000"):
        assert steps in code
        code = code.replace(steps, "512")
    train = ["-m", "gym_mara.cli", "train", "--steps", "512", "--out", "runs/first"]
    for arguments in (train, ["-c", code]):
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr


def test_every_breaking_change_since_the_first_version_has_a_note() -> None:
    changes = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("## [0.1.0]")[0]
    notes, counted = 0, False
    for line in (ROOT / "docs" / "upgrade.md").read_text(encoding="utf-8").splitlines():
        counted = line.startswith("| change | what you see | now |") or (
            counted and line.startswith("|")
        )
        notes += counted and not line.startswith(("| change", "|---"))
    assert notes == changes.count("**Breaking:**") > 0


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
