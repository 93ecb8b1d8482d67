"""Links of the pages, which are those of the files in the repository, as links of the site."""

import os
import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parents[1]
ROOT = DOCS.parent
PAGES = {
    "README.md": "start.md",
    "CHANGELOG.md": "repository/changelog.md",
    "CONTRIBUTING.md": "repository/contributing.md",
    "SECURITY.md": "repository/security.md",
    "examples/lag_backend/README.md": "repository/lag_backend.md",
    "robots/mara/README.md": "repository/mara.md",
}
"""The pages that include a file from outside docs/."""
_LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\]]*\])*\])\(([^)\s:#]+)(#[^)\s]*)?\)")


def of_site(text: str, file: Path, page: Path) -> str:
    """The text of a file with links that are right on the page that shows it.

    A link to an included file leads to the page that includes it. A link to a folder outside docs/ becomes plain text.

    Args:
        text: Markdown.
        file: whose text it is, from where its links are relative.
        page: which shows the text.
    """

    def moved(link: re.Match[str]) -> str:
        label, path, anchor = link.groups(default="")
        target = (file.parent / path).resolve()
        if target.is_dir():
            return label.removeprefix("!")[1:-1]
        if target.is_relative_to(ROOT):
            name = target.relative_to(ROOT).as_posix()
            target = DOCS / PAGES[name] if name in PAGES else target
        return f"{label}({os.path.relpath(target, page.parent)}{anchor})"

    return _LINK.sub(moved, text)


def _page_read(app: Sphinx, name: str, text: list[str]) -> None:
    page = Path(app.env.doc2path(name))
    text[0] = of_site(text[0], page, page)


def _file_included(app: Sphinx, path: Path, name: str, text: list[str]) -> None:
    page = Path(app.env.doc2path(app.env.docname))
    text[0] = of_site(text[0], (DOCS / path).resolve(), page)


def setup(app: Sphinx) -> dict[str, Any]:
    """Sphinx calls this for an extension."""
    app.connect("source-read", _page_read)
    app.connect("include-read", _file_included)
    return {"parallel_read_safe": True}
