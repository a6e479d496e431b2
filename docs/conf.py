"""The documentation site: Sphinx over the Markdown pages and the docstrings."""

from __future__ import annotations

import icrtool

project = "icrtool"
author = "the icrtool developers"
version = release = icrtool.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.mathjax", "sphinx.ext.napoleon", "sphinx_click"]
html_theme = "furo"
html_title = f"icrtool {version}"
html_static_path: list[str] = []
exclude_patterns = ["_build"]

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "none"
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False

# Pages link to files outside docs/ (README, CHANGELOG, sample logs): right in the repository, absent from the site.
suppress_warnings = ["myst.xref_missing"]
