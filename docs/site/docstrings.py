"""Docstrings as reStructuredText: sections as Google writes them, `code` in backticks, and all other signs as they are."""

import re
from typing import Any

from sphinx.application import Sphinx
from sphinx.ext.napoleon import Config
from sphinx.ext.napoleon.docstring import GoogleDocstring

# Code in backticks, which stays; or a sign that means something else in reStructuredText.
_SIGNS = re.compile(r"`[^`]+`|[*|]|(?<=\w)_(?!\w)")
_ALIAS = re.compile(r"TypeAliasForwardRef\('(\w+)'\)")
_CONFIG = Config(napoleon_use_rtype=False)


def _escaped(sign: re.Match[str]) -> str:
    return sign[0] if sign[0].startswith("`") else f"\\{sign[0]}"


def _convert(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    text = _SIGNS.sub(_escaped, "\n".join(lines))
    lines[:] = text.splitlines()
    if what not in (
        "attribute",
        "data",
        "property",
    ):  # where Napoleon takes "a word: more" for a type
        lines[:] = GoogleDocstring(lines, _CONFIG, app, what, name, thing, options).lines()


def _with_aliases(app: Sphinx, *signature: Any) -> tuple[str | None, ...]:
    """A signature in which a type that has a name of its own, such as Floats, has this name also within another type."""
    return tuple(text and _ALIAS.sub(r"\1", text) for text in signature[-2:])


def setup(app: Sphinx) -> dict[str, Any]:
    """Sphinx calls this for an extension."""
    app.setup_extension("sphinx.ext.autodoc")
    app.connect("autodoc-process-docstring", _convert)
    app.connect("autodoc-process-signature", _with_aliases)
    return {"parallel_read_safe": True}
