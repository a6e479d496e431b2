"""The documentation site: Sphinx over the Markdown pages and the docstrings; it needs no network to be read."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml

import icrtool

if TYPE_CHECKING:
    from sphinx.application import Sphinx

project = "icrtool"
author = "the icrtool developers"
version = release = icrtool.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx_click"]
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

html_math_renderer = "mathml"

# Quotes and hyphens of commands stay as they are typed.
smartquotes = False


def write_mathml(translator: Any, node: nodes.math | nodes.math_block) -> None:  # noqa: ANN401 - a translator of Sphinx
    """Write an equation as MathML, which browsers draw themselves."""
    translator.body.append(tex2mathml(node.astext(), as_block=isinstance(node, nodes.math_block)))
    raise nodes.SkipNode


def move_meanings(_: Sphinx, *args: Any) -> None:
    """Move what our docstrings state behind ``name :`` to the line below, where numpydoc has the description."""
    lines: list[str] = args[-1]
    found = []
    for line in lines:
        head = re.match(r"(\w[\w, ]*) : (.*)", line)
        found += [head[1], f"    {head[2]}"] if head else [line]
    lines[:] = found


def keep_limits(_: Sphinx, document: nodes.document) -> None:
    """Turn limits such as ``icr.p95@10m``, which look like addresses, back into text."""
    for one in list(document.findall(nodes.reference)):
        if one.get("refuri", "").startswith(("mailto:", "tcp:")):
            one.replace_self(one.children)


def setup(app: Sphinx) -> None:
    """Enter the functions above."""
    app.add_html_math_renderer("mathml", (write_mathml, None), (write_mathml, None))
    app.connect("autodoc-process-docstring", move_meanings, priority=400)
    app.connect("doctree-read", keep_limits)
