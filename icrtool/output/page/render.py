"""Templates and pictures to HTML: all texts are escaped, all content is in the file, and nothing else may be loaded."""

from __future__ import annotations

import json
import re
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from hashlib import blake2b, sha256
from importlib.resources import files
from pathlib import PurePath
from typing import TYPE_CHECKING, NamedTuple

from icrtool import __version__
from icrtool.errors import RunError
from icrtool.output.text_blocks import Block, stated_blocks
from icrtool.records.places import Below, read_regular
from icrtool.records.plain_data import plain_value
from icrtool.records.text import escaped

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup
    from matplotlib.figure import Figure

DOCUMENT_ERRORS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""Errors that a page raises for a JSON document that was edited."""

STYLE_SHEETS = ("vendor/uPlot.min.css", "page.css")

BEGIN = "document.documentElement.classList.replace('no-js', 'js');"
"""Script that runs before anything is shown. Without scripts, elements that only a script can draw stay hidden."""

UNIT = re.compile(r"(?<=\d) (?=(?:m|cm|mm|km|s|min|h|Hz|m/s|%|°|±)(?![\w]))|(?<=±) (?=[\d.])")
"""The space between a value and its unit, and the spaces around ±."""
RANGE = re.compile(r"(?<=\d)-(?=\d+(\.\d+)?\xa0)")
"""The hyphen of a range of values."""

MINUS = re.compile(r"(?<![\w.)])-(?=\d)")
"""The sign of a negative number."""

IN_SCRIPT = {ord("<"): "\\u003c", ord(">"): "\\u003e", ord("&"): "\\u0026"}
"""Escapes in JSON, so that no text in it can end the element around it."""


def render(
    scripts: Sequence[str], data: Mapping[str, object] | None, *, title: str, kind: str, blocks: Sequence[Block],
    **content: object,
) -> str:  # fmt: skip
    """Return a page as HTML; text in it is escaped twice: for a reader, and for HTML.

    Parameters
    ----------
    scripts : names of files in ``static``, in the order in which they run
    data : data for the scripts; None: nothing
    kind : kind of the report, for its title
    blocks : content of the page; the first `Title` among them is its heading
    content : values that the templates of drawings name
    """
    from markupsafe import Markup

    style = "\n".join(_static(name) for name in STYLE_SHEETS)
    code = [BEGIN, *(_static(name) for name in scripts)]
    # Hashes in the form in which a content security policy names a style or a script.
    of_style, *of_scripts = (
        f"'sha256-{b64encode(sha256(text.encode()).digest()).decode('ascii')}'" for text in (style, *code)
    )
    policy = (
        f"default-src 'none'; img-src data:; style-src {of_style}; "
        f"script-src {' '.join(of_scripts)}; base-uri 'none'; form-action 'none'"
    )
    # JSON with any text that is safe in a script element.
    written = json.dumps(plain_value(data), allow_nan=False, separators=(",", ":")).translate(IN_SCRIPT)
    return _environment().get_template("base.html").render(
        # Texts of icrtool, not of a log: they are not escaped.
        policy=policy, style=Markup(style), begin=Markup(BEGIN), scripts=[Markup(script) for script in code[1:]],  # noqa: S704
        data=None if data is None else Markup(written),  # noqa: S704 - escaped for a script element
        tool_version=__version__, title=title, kind=kind, blocks=list(stated_blocks(blocks)),
        **{"pictures": {}, **content},
    )  # fmt: skip


@cache
def _environment() -> Environment:
    """Return the templates, compiled once a process."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup, escape

    def shown(value: object) -> object:
        """Return the printed text of a value, without characters that hide or reorder other characters."""
        return escaped(value) if isinstance(value, str) and not isinstance(value, Markup) else value

    def with_units(text: str) -> Markup:
        """Return a text whose values stay on one line with their units and standard deviations."""
        printed = MINUS.sub("−", str(escape(escaped(text))))
        return Markup(RANGE.sub("\u2011", UNIT.sub("\xa0", printed)))  # noqa: S704 - escaped

    environment = Environment(
        loader=PackageLoader("icrtool.output.page"), autoescape=True, undefined=StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, finalize=shown,
    )  # fmt: skip
    environment.filters |= {
        "units": with_units,
        # On a narrow screen a name may be broken after its underscores.
        "breakable": lambda name: Markup("_<wbr>").join(map(escape, escaped(name).split("_"))),
        "sentence": lambda text: f"{text[:1].upper()}{text[1:]}",
        "grouped": _grouped,
        "kind": lambda block: type(block).__name__,
        "named": lambda pictures, names: [picture for name, picture in pictures.items() if name.startswith(names)],
    }
    return environment


def _grouped(rows: Sequence[tuple[str, str]]) -> list[tuple[str, list[str]]]:
    """Return labelled sentences by label; a sentence without a label belongs to the label before it."""
    groups: list[tuple[str, list[str]]] = []
    for name, text in rows:
        if name or not groups:
            groups.append((name, []))
        groups[-1][1].append(text)
    return groups


def _static(name: str) -> str:
    return files("icrtool.output.page").joinpath("static", *name.split("/")).read_text(encoding="utf-8")


SIGNATURE = b"\x89PNG\r\n\x1a\n"

LARGEST_PICTURE_BYTES = 1 << 24
"""Largest size of a picture that is read [bytes]. Pictures of icrtool have less than 1 MB."""

PICTURE = re.compile(r"[a-z_]{1,40}(_\d{1,4}m)?")
"""Pattern of the names of icrtool's pictures, without the suffix."""


class Picture(NamedTuple):
    """One picture of a page.

    Attributes
    ----------
    title, caption : one line each: what it shows, what to look for
    source : data URL
    with_place : its axes may be coordinates of a map grid
    """

    title: str
    caption: str
    source: str
    with_place: bool


def drawn_pictures(figures: Iterable[tuple[str, Figure]]) -> dict[str, Picture]:
    """Return figures as pictures, by name."""
    from icrtool.output.figures.style import picture_bytes

    return pictures_of((name, picture_bytes(figure, "png")) for name, figure in figures)


def pictures_in(directory: Below, sums: Mapping[str, str] | None = None) -> dict[str, Picture]:
    """Return the PNG pictures of a folder that this module knows, by name; none where the folder is not there.

    Parameters
    ----------
    sums : BLAKE2b sums (hex) of files by their path from `directory.folder`, where they are known

    Raises
    ------
    RunError
        A file is not a picture that icrtool made: a link, another file, too large, or with another sum.
    """
    from icrtool.output.figure_catalogue import entry_of

    stems = [file.stem for file in sorted(directory.path.glob("*.png"))]
    return pictures_of(
        (stem, _png(Below(directory.folder, f"{directory.name}/{stem}.png"), sums or {}))
        for stem in stems
        if PICTURE.fullmatch(stem) and entry_of(stem)
    )


def _png(file: Below, sums: Mapping[str, str]) -> bytes:
    name = PurePath(file.name).as_posix()
    try:
        content = read_regular(file, LARGEST_PICTURE_BYTES)
    except OSError as err:
        raise RunError(file.folder, f"{name} cannot be read ({err.strerror})", "remove it") from err
    if not content.startswith(SIGNATURE):
        raise RunError(file.folder, f"{name} is not a PNG picture", "remove it")
    if sums.get(name, digest := blake2b(content).hexdigest()) != digest:
        raise RunError(file.folder, f"{name} was edited or cut short since the run", "remove it, or fit the log again")
    return content


def pictures_of(files: Iterable[tuple[str, bytes]]) -> dict[str, Picture]:
    """Return pictures given as name and PNG file."""
    from icrtool.output.figure_catalogue import entry_of

    pictures = {}
    for name, content in files:
        if (of_catalogue := entry_of(name)) is not None:
            entry, metres = of_catalogue
            source = f"data:image/png;base64,{b64encode(content).decode('ascii')}"
            pictures[name] = Picture(entry.title.format(metres), entry.caption, source, entry.with_place)
    return pictures
