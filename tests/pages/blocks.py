"""The blocks of the documentation's pages: Python, and commands of a shell."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import NamedTuple

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[2]
PAGES = sorted(
    page.relative_to(ROOT).as_posix()
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").rglob("*.md")]
    if "_build" not in page.parts
)
PROGRAMS = ("gym-mara", "make", "mkdir", "pip", "pytest", "python", "export", "ray", "ros2")
"""What a line of a shell block begins with."""
_MARKER = re.compile(r"<!-- parsed only: (.+) -->\s*")


class Block(NamedTuple):
    """A block of a page."""

    page: str
    """Its path in the repository."""
    line: int
    """The line before its first one."""
    language: str
    """What follows the three backticks; "" for an indented block."""
    text: str
    parsed_only: str
    """The reason in the comment before the block for which it is not run, `<!-- parsed only: … -->`; "" if it is run."""

    @property
    def commands(self) -> list[list[str]]:
        """The commands of a shell block, each as its words; empty for another block."""
        lines = self.text.replace("\\\n", " ").splitlines()
        words = (
            [shlex.split(line, comments=True) for line in lines] if self._is_shell(lines) else []
        )
        return [line for line in words if line]

    def _is_shell(self, lines: list[str]) -> bool:
        if self.language == "sh":
            return True
        first = [re.split(r"\s", line.removeprefix(".venv/bin/"))[0] for line in lines]
        return not self.language and bool({*first} & {*PROGRAMS})


def blocks(page: str) -> list[Block]:
    """The blocks of a page in their order."""
    found, reason = [], ""
    for token in MarkdownIt("commonmark").enable("table").parse((ROOT / page).read_text("utf-8")):
        marker = token.type == "html_block" and _MARKER.fullmatch(token.content)
        if marker:
            reason = marker[1]
        elif token.type in ("fence", "code_block"):
            assert token.map is not None
            line = token.map[0] + (token.type == "fence")
            found.append(Block(page, line, token.info, token.content, reason))
            reason = ""
        else:
            assert not reason, f"{page}: {token.map}: a block must follow the comment {reason!r}"
    return found
