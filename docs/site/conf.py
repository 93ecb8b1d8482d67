"""Sphinx's settings for the site of this documentation; `make docs` builds it into docs/_build/html."""

import sys
from importlib.util import find_spec
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

import gym_mara

project = "gym_mara"
author = copyright = "The gym_mara contributors"  # noqa: A001 - Sphinx's name
version = release = gym_mara.__version__
extensions = [
    "docstrings",
    "environment_facts",
    "myst_parser",
    "repository_links",
]
exclude_patterns = ["_build", "site"]
root_doc = "index"
nitpicky = True
nitpick_ignore_regex = [
    ("py:.*", r"(?!gym_mara\.).*"),  # other libraries, whose sites are not looked at
    (
        "py:class",
        r"gym_mara\.(backends\.randomisation|envs\.(outcome|simulation)|robot\.(bounds|description|diagnosis|geometry))\..*",
    ),  # no part of the API
]

myst_heading_anchors = 4
highlight_language = "none"
default_role = "code"  # of a word in `backticks` in a docstring

autodoc_member_order = "bysource"
autodoc_type_aliases = {
    name: name for name in ("Array", "ArrayLike", "Floats", "Mask", "PerJoint", "RobotLike")
}
autodoc_typehints_format = "short"
autodoc_mock_imports = [
    name for name in ("onnx", "rclpy", "rosbags", "ruckig", "torch") if find_spec(name) is None
]

html_theme = "furo"
html_title = f"gym_mara {release}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_copy_source = False
