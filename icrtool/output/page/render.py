"""Templates to HTML: everything is escaped, scripts and styles stand in the file, and nothing else may be loaded."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from functools import cache
from hashlib import sha256
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from icrtool import __version__
from icrtool.output import text_format
from icrtool.output.text_format import error_text
from icrtool.records.plain_data import plain
from icrtool.records.text import digits_of, escaped, with_std

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

DOCUMENT_ERRORS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""What a page raises for a JSON document that was edited."""

STYLES = ("vendor/uPlot.min.css", "page.css")

BEGIN = "document.documentElement.classList.replace('no-js', 'js');"
"""Carried out before anything is shown: what only a script can draw is hidden without one."""

UNIT = re.compile(r"(?<=\d) (?=(?:m|cm|mm|km|s|min|h|Hz|m/s|%|°|±)(?![\w]))|(?<=±) (?=[\d.])")
"""The space between a value and its unit, and those about ±."""
RANGE = re.compile(r"(?<=\d)-(?=\d+(\.\d+)?\xa0)")
"""The hyphen of a range of values."""

IN_SCRIPT = {ord("<"): "\\u003c", ord(">"): "\\u003e", ord("&"): "\\u0026"}
"""Escapes in JSON, so that no text in it can end the element it stands in."""


def render(template: str, scripts: Sequence[str], data: Mapping[str, Any] | None, **content: object) -> str:
    """Return a page as HTML.

    Parameters
    ----------
    template : name of a file in ``templates``
    scripts : names of files in ``static``, in the order they are carried out
    data : what the scripts read; None: nothing
    content : what the template names; text in it is escaped, twice: for a reader, and for HTML
    """
    from markupsafe import Markup

    style = "\n".join(_static(name) for name in STYLES)
    code = [BEGIN, *(_static(name) for name in scripts)]
    policy = (
        f"default-src 'none'; img-src data:; style-src {_source(style)}; "
        f"script-src {' '.join(map(_source, code))}; base-uri 'none'; form-action 'none'"
    )
    return _environment().get_template(template).render(
        # Ours, not of a log: they stand in the page as they are.
        policy=policy, style=Markup(style), begin=Markup(BEGIN), scripts=[Markup(one) for one in code[1:]],  # noqa: S704
        data=Markup(script_json(data)) if data is not None else None,  # noqa: S704 - escaped for a script element
        tool_version=__version__, **content,
    )  # fmt: skip


@cache
def _environment() -> Environment:
    """Return the templates, compiled once a process."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup

    def shown(value: object) -> object:
        """Return what is printed for a value: text without characters that hide or reorder others."""
        return escaped(value) if isinstance(value, str) and not isinstance(value, Markup) else value

    environment = Environment(
        loader=PackageLoader("icrtool.output.page"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=shown,
    )  # fmt: skip
    environment.filters |= {
        "metres": lambda value: "–" if value is None else _with_units(error_text(value)),
        "distance": lambda value: _with_units(text_format.distance_text(value)),
        "duration": lambda value: _with_units(text_format.duration_text(value)),
        "signed": text_format.signed,
        "digits": digits_of,
        "with_std": lambda *numbers: with_std(*numbers).replace("-", "−"),
        "units": _with_units,
        "breakable": _breakable,
        "minus": _minus,
        "turn": _turn,
    }
    return environment


def script_json(data: Mapping[str, Any]) -> str:
    """Return JSON that can stand in a script element, whatever text it holds."""
    return json.dumps(plain(data), allow_nan=False, separators=(",", ":")).translate(IN_SCRIPT)


def _with_units(text: str) -> Markup:
    """Return a text whose values stay on one line with their units and standard deviations."""
    from markupsafe import Markup, escape

    return Markup(RANGE.sub("\u2011", UNIT.sub("\xa0", str(escape(escaped(text))))))  # noqa: S704 - escaped


def _breakable(name: str) -> Markup:
    """Return a name that may be broken behind its underscores, on a narrow screen."""
    from markupsafe import Markup, escape

    return Markup("_<wbr>").join(escape(part) for part in escaped(name).split("_"))


def _minus(value: float, digits: int, sign: str = "") -> str:
    """Return a number as print has it: a minus, not a hyphen, and no sign before zero."""
    return f"{round(value, digits) + 0.0:{sign}.{digits}f}".replace("-", "−")


def _turn(trial: Mapping[str, Any]) -> str:
    """Return the turn of a trial, as ``96° left``."""
    degrees = trial["heading_change_deg"]
    return f"{abs(degrees):.0f}° {'right' if degrees > 0 else 'left'}"


def _static(name: str) -> str:
    return files("icrtool.output.page").joinpath("static", *name.split("/")).read_text(encoding="utf-8")


def _source(text: str) -> str:
    """Return a style or script as the content security policy names it."""
    return f"'sha256-{b64encode(sha256(text.encode()).digest()).decode('ascii')}'"
