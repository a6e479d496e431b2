"""Pages as HTML: all texts are escaped, all content is in the file, and the page may load nothing else."""

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
from icrtool.output.text_blocks import Block, filled_blocks
from icrtool.records.places import Below, read_regular
from icrtool.records.plain_data import plain_value
from icrtool.records.text import escaped

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup
    from matplotlib.figure import Figure

DOCUMENT_ERRORS = (LookupError, TypeError, ValueError, AttributeError, ArithmeticError)
"""Errors that are raised while a page is made of a JSON document that was edited."""

STYLE_SHEETS = ("vendor/uPlot.min.css", "page.css")
"""Style sheets of every page, in ``static``."""

BEGIN = "document.documentElement.classList.replace('no-js', 'js');"
"""Script that runs before anything is shown. If scripts are off, elements that only a script can draw stay hidden."""

UNIT = re.compile(r"(?<=\d) (?=(?:m|cm|mm|km|s|min|h|Hz|m/s|%|°|±)(?![\w]))|(?<=±) (?=[\d.])")
"""Pattern of the space between a value and its unit, and of the spaces around ±."""

RANGE = re.compile(r"(?<=\d)-(?=\d+(\.\d+)?\xa0)")
"""Pattern of the hyphen in a range of values."""

MINUS = re.compile(r"(?<![\w.)])-(?=\d)")
"""Pattern of the sign of a negative number."""

IN_SCRIPT = {ord("<"): "\\u003c", ord(">"): "\\u003e", ord("&"): "\\u0026"}
"""Escapes of characters in JSON. Without them a text could end the script element around it."""


def render(
    scripts: Sequence[str], data: Mapping[str, object] | None, *, title: str, kind: str, blocks: Sequence[Block],
    **content: object,
) -> str:  # fmt: skip
    """Return a page as HTML. Its texts are escaped for a reader (control characters), and for HTML.

    Parameters
    ----------
    scripts : names of files in ``static``, in the order in which they run
    data : data for the scripts; None: no data
    title, kind : title of the page, and kind of the report
    blocks : content of the page; the first `Title` among them is its heading
    content : further values that the templates use
    """
    from markupsafe import Markup

    style = "\n".join(_static(name) for name in STYLE_SHEETS)
    code = [BEGIN, *(_static(name) for name in scripts)]
    # Hashes in the form in which a content security policy names a style or a script.
    style_hash, *script_hashes = (
        f"'sha256-{b64encode(sha256(text.encode()).digest()).decode('ascii')}'" for text in (style, *code)
    )
    policy = (
        f"default-src 'none'; img-src data:; style-src {style_hash}; "
        f"script-src {' '.join(script_hashes)}; base-uri 'none'; form-action 'none'"
    )
    # The JSON is escaped, so that it is safe in a script element.
    written = json.dumps(plain_value(data), allow_nan=False, separators=(",", ":")).translate(IN_SCRIPT)
    return _environment().get_template("base.html").render(
        # These texts are icrtool's own and not of a log, so they are not escaped.
        policy=policy, style=Markup(style), begin=Markup(BEGIN), scripts=[Markup(script) for script in code[1:]],  # noqa: S704
        data=None if data is None else Markup(written),  # noqa: S704 - escaped for a script element
        tool_version=__version__, title=title, kind=kind, blocks=list(filled_blocks(blocks)),
        **{"pictures": {}, **content},
    )  # fmt: skip


@cache
def _environment() -> Environment:
    """Return the environment of the templates, which are compiled once in a process."""
    from jinja2 import Environment, PackageLoader, StrictUndefined
    from markupsafe import Markup, escape

    def shown(value: object) -> object:
        """Return a value for a page; in a text, characters that hide or reorder other characters are escaped."""
        return escaped(value) if isinstance(value, str) and not isinstance(value, Markup) else value

    def with_units(text: str) -> Markup:
        """Return a text in which no line breaks between a value and its unit or standard deviation."""
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
    """Return the sentences of each label, in order; a sentence without a label belongs to the label before it."""
    groups: list[tuple[str, list[str]]] = []
    for name, text in rows:
        if name or not groups:
            groups.append((name, []))
        groups[-1][1].append(text)
    return groups


def _static(name: str) -> str:
    """Return the text of a file in ``static``."""
    return files("icrtool.output.page").joinpath("static", *name.split("/")).read_text(encoding="utf-8")


SIGNATURE = b"\x89PNG\r\n\x1a\n"
"""First bytes of a PNG file."""

LARGEST_PICTURE_BYTES = 1 << 24
"""Largest size of a picture that is read [bytes]. icrtool's pictures have less than 1 MB."""

PICTURE = re.compile(r"[a-z_]{1,40}(_\d{1,4}m)?")
"""Pattern of the names of icrtool's pictures without their suffix."""


class Picture(NamedTuple):
    """A picture of a page.

    Attributes
    ----------
    title, caption : content of the picture, and what to look for, one line each
    source : the PNG file as a data URL
    with_place : whether its axes may be coordinates of a map grid
    """

    title: str
    caption: str
    source: str
    with_place: bool


def drawn_pictures(figures: Iterable[tuple[str, Figure]]) -> dict[str, Picture]:
    """Return named figures as pictures by name."""
    from icrtool.output.figures.style import picture_bytes

    return pictures_of((name, picture_bytes(figure, "png")) for name, figure in figures)


def pictures_in(directory: Below, sums: Mapping[str, str] | None = None) -> dict[str, Picture]:
    """Return icrtool's PNG pictures in a folder by name; none if the folder does not exist.

    Parameters
    ----------
    directory : the folder
    sums : known BLAKE2b checksums (hex) of files, by their path relative to `directory.folder`

    Raises
    ------
    RunError
        A file with the name of a picture is a link, no PNG file, too large, or has another checksum.
    """
    from icrtool.output.figure_catalogue import entry_of

    stems = [file.stem for file in sorted(directory.path.glob("*.png"))]
    return pictures_of(
        (stem, _png(Below(directory.folder, f"{directory.name}/{stem}.png"), sums or {}))
        for stem in stems
        if PICTURE.fullmatch(stem) and entry_of(stem)
    )


def _png(file: Below, sums: Mapping[str, str]) -> bytes:
    """Return the bytes of a PNG file; parameters and errors as in `pictures_in`."""
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
    """Return named PNG files as pictures by name; a name that is not in the catalogue is left out."""
    from icrtool.output.figure_catalogue import entry_of

    pictures = {}
    for name, content in files:
        if (catalogue_entry := entry_of(name)) is not None:
            entry, metres = catalogue_entry
            source = f"data:image/png;base64,{b64encode(content).decode('ascii')}"
            pictures[name] = Picture(entry.title.format(metres), entry.caption, source, entry.with_place)
    return pictures
