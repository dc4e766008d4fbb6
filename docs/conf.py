"""The site of the documentation: `make docs` builds it, and a warning fails the build.

Sources are all Markdown of the repository, so that a link means the same here as in the files.
"""

import re
from typing import Any

import mrcdrl

project = "MRCDRL"
release = mrcdrl.__version__
language = "en"
root_doc = "docs/index"
include_patterns = ["*.md", "docs/**.md", "benchmarks/results/**.md"]
exclude_patterns = [".*", "build", "common", "dist", "mrcdrl", "runs", "services", "tests"]
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx_copybutton", "sphinx_design"]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
autodoc_member_order = "bysource"
maximum_signature_line_length = 80

html_title = f"{project} {release}"
html_theme = "pydata_sphinx_theme"
html_theme_options = {"navbar_end": ["theme-switcher"], "footer_start": [], "footer_end": []}
html_extra_path = ["site"]  # index.html, which leads to root_doc
html_copy_source = False


def _as_markup(
    _app: Any, _what: str, _name: str, _of: Any, _options: Any, lines: list[str]
) -> None:
    """Code in docstrings stands in single backquotes, which reStructuredText doubles."""
    lines[:] = [re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", line) for line in lines]


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _as_markup)
