"""Sphinx's settings for the site of this documentation; `make docs` builds it into docs/_build/html."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import gym_mara

project = "gym_mara"
author = copyright = "The gym_mara contributors"  # noqa: A001 - Sphinx's name
version = release = gym_mara.__version__
extensions = ["myst_parser", "environment_facts", "repository_links"]
exclude_patterns = ["_build", "site"]
root_doc = "index"
nitpicky = True

myst_heading_anchors = 4
highlight_language = "none"

html_theme = "furo"
html_title = f"gym_mara {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
