"""The words of CONTRIBUTING.md that are not used do not occur in the packages and pages that are listed as done.

``python tests/test_language.py`` counts them for every package.
"""

from __future__ import annotations

import functools
import io
import re
import tokenize
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
NOT_USED = CONTRIBUTING.partition("## Words not to use")[2].partition("\n## ")[0]

DONE: tuple[str, ...] = (
    "__init__",
    "__main__",
    "cli",
    "config",
    "errors",
    "estimation",
    "figures",
    "fleet",
    "kernels",
    "logs",
    "calibration",
    "motion",
    "records",
    "simulation",
    "dropout_analysis",
    "output",
    "alignment",
)
"""Packages and modules of icrtool without a word from the left column. Add to it; take nothing from it."""

PUBLISHED = (
    "way_noise",
    "gyro_course",
    "wheels_course",
    "too_little_way_left",
    "blind_icr_10m_p95_m",
    "blind_no_slip_10m_p95_m",
    "sold_as_fixed",
    "gyro_course",
    "wheels_course",
    "rise_",
    '"way_m"',
)
"""Keys and values in files that users read: they never change."""

PAGES = (
    "CHANGELOG.md",
    "README.md",
    "CONTRIBUTING.md",
    "SECURITY.md",
    "sample_logs/README.md",
    *(page.relative_to(ROOT).as_posix() for page in sorted((ROOT / "docs").rglob("*.md"))),
)


def words_not_to_use() -> dict[str, str]:
    """Return for each word not to use what to use instead."""
    rows = re.findall(r"^\| (`.*?) \| (.+?) \|$", NOT_USED, re.MULTILINE)
    return {word: instead for words, instead in rows for word in re.findall(r"`([^`]+)`", words)}


WORDS = words_not_to_use()
PATTERN = re.compile(rf"\b(?:{'|'.join(sorted(map(re.escape, WORDS), key=len, reverse=True))})\b", re.IGNORECASE)
INSTEAD = re.compile(
    "|".join(re.escape(one) for text in set(WORDS.values()) for one in text.split(", ")), re.IGNORECASE
)


SHORT_IN_NAMES = ("course",)
"""What prose writes in full (course over ground), a name may shorten (``CourseComparison``)."""


@functools.cache
def found_in_text(text: str) -> list[str]:
    """List the words not to use in a text, each with what to use instead."""
    for key in PUBLISHED:
        text = text.replace(key, "")
    text = re.sub(r"\s+", " ", text.replace("_", " "))
    if not PATTERN.search(text):
        return []
    rest = INSTEAD.sub(lambda hit: " " * len(hit.group()), text)
    return [f"{hit.group()}: write {WORDS[hit.group().lower()]}" for hit in PATTERN.finditer(rest)]


# Python 3.12 and later split an f-string into tokens of its own.
TEXT_TOKENS = {tokenize.STRING, tokenize.COMMENT, getattr(tokenize, "FSTRING_MIDDLE", tokenize.STRING)}


def found_in_source(source: str) -> list[str]:
    """List the words not to use in names, strings and comments.

    A name after a dot is the other side's (``ast.walk``, ``os.walk``); its definition is where it counts.
    """
    found, before = [], ""
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        words = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", token.string) if token.type == tokenize.NAME else token.string
        name = token.type == tokenize.NAME and before != "."
        if name or token.type in TEXT_TOKENS:
            found += [
                f"{token.start[0]}: {what}"
                for what in found_in_text(words)
                if not (name and what.partition(":")[0].lower() in SHORT_IN_NAMES)
            ]
        before = token.string
    return found


def modules(part: str) -> list[Path]:
    place = ROOT / "icrtool" / part
    return sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]


def found_in_part(part: str) -> list[str]:
    return [
        f"{path.relative_to(ROOT)}:{what}"
        for path in modules(part)
        for what in found_in_source(path.read_text(encoding="utf-8"))
    ]


@pytest.mark.parametrize("part", DONE)
def test_package_has_no_word_that_is_not_used(part: str) -> None:
    assert not (found := found_in_part(part)), "\n".join(found)


@pytest.mark.parametrize("page", PAGES)
def test_page_has_no_word_that_is_not_used(page: str) -> None:
    text = re.sub(r"```.*?```|`[^`]*`", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    assert not (found := found_in_text(text)), "\n".join(found)


def test_the_table_of_words_is_read() -> None:
    assert WORDS["misses"] == "residuals, Jacobian"
    assert "taken out" in WORDS


@pytest.mark.parametrize(
    ("source", "word"),
    [
        ("def f(way_m): pass", "way"),
        ("class FixQuality: pass", "fix quality"),
        ('"""Heading is\ntaken out."""', "taken out"),
        ("x = f'{x} m blind'", "blind"),
        ("y = 1  # judged by the course", "judged"),
        ("y = 1  # the course", "course"),
    ],
)
def test_a_word_not_to_use_is_found(source: str, word: str) -> None:
    assert any(word in " ".join(found.lower().split()) for found in found_in_source(source))


@pytest.mark.parametrize(
    "source",
    [
        "y = 1  # course over ground",
        "course_over_ground = 1",
        "class CourseComparison: pass",
        "for n in ast.walk(x): pass",
        "always = 'latest'",
    ],
)
def test_other_words_are_not(source: str) -> None:
    assert found_in_source(source) == []


if __name__ == "__main__":
    import collections

    for part in sorted({path.stem for path in (ROOT / "icrtool").iterdir() if path.suffix == ".py" or path.is_dir()}):
        counts = collections.Counter(what.split(": ")[1].lower() for what in found_in_part(part))
        print(f"{part:18} {counts.total():4}  {', '.join(f'{word} {n}' for word, n in counts.most_common(8))}")
