"""The site of the documentation: `make docs` builds it and runs the notebooks; a warning fails it.

Sources are all Markdown of the repository, so that a link means the same here as in the files.
"""

import re
from typing import Any

import mrcdrl

project = "MRCDRL"
release = mrcdrl.__version__
language = "en"
root_doc = "docs/index"
include_patterns = [
    *("*.md", "docs/**.md", "docs/notebooks/*.ipynb"),
    *("benchmarks/results/**.md", "pretrained/*/README.md"),
]
exclude_patterns = [".*", "build", "common", "dist", "mrcdrl", "runs", "services", "tests"]
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton", "sphinx_design"]

myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 4
nb_execution_mode = "auto"  # notebooks are kept without outputs: the build makes them
nb_execution_raise_on_error = True
nb_execution_timeout = 600  # s, of a cell: the first one may compile
nb_merge_streams = True
autodoc_member_order = "bysource"

html_title = f"{project} {release}"
html_theme = "pydata_sphinx_theme"
html_theme_options = {"navbar_end": ["theme-switcher"], "footer_start": [], "footer_end": []}
html_extra_path = ["site"]  # index.html, which leads to root_doc
html_copy_source = False
html_static_path = ["static"]
html_js_files = ["accessible.js"]


def _as_markup(
    _app: Any, _what: str, _name: str, _of: Any, _options: Any, lines: list[str]
) -> None:
    """Code in docstrings stands in single backquotes, which reStructuredText doubles."""
    lines[:] = [re.sub(r"(?<!`)`([^`]+)`(?!`)", r"``\1``", line) for line in lines]


def setup(app: Any) -> None:
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", _as_markup)
