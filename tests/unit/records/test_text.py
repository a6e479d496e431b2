"""Text from a log prints only escaped and shortened, however it reaches the output."""

from __future__ import annotations

import pickle

import pytest

from icrtool.errors import LogError
from icrtool.records.text import LONGEST_MESSAGE, LONGEST_NAME, LogText

HOSTILE = {
    "clears the screen": "\x1b[2J", "sets the title": "\x1b]0;t\x07", "new line": "a\nError: b", "return": "a\rb",
    "C1 control": "\x9b31m", "override": "a\u202eb", "isolate": "\u2066", "zero width": "a\u200bb\ufeff",
    "surrogate": "\udc80", "separator": "\u2028", "tag": "\U000e0041", "NUL": "\0",
}  # fmt: skip


@pytest.mark.parametrize("raw", HOSTILE.values(), ids=HOSTILE)
def test_whatever_is_made_of_it_is_printable(raw: str) -> None:
    text = LogText(raw)
    made = [
        str(text),
        f"{text}",
        f"{text:>9}",
        "{}".format(text),  # noqa: UP032 - what is tested
        "".join(iter([text, text])),
        text + "",
        text[:],
        repr(text),
    ]
    made += [*text.partition("a"), text.strip(), f"{LogError(text, text, text)}", f"{[text]}", f"{LogError(raw, raw)}"]
    assert all(each.isprintable() for each in made)
    assert text.raw == raw
    assert pickle.loads(pickle.dumps(text)).raw == raw


def test_a_long_name_is_shortened_in_print_and_stays_itself() -> None:
    one, other = LogText("/a" * 100 + "b" + "/a" * 500), LogText("/a" * 100 + "c" + "/a" * 500)
    assert len(str(one)) == len(f"{one}") == LONGEST_NAME
    assert str(one) == str(other)
    assert one != other
    assert len(str(LogError("x" * 100_000, "y" * 100_000))) == LONGEST_MESSAGE


def test_an_ordinary_name_is_unchanged() -> None:
    assert f"{LogText('/imu/data é')}" == "/imu/data é"
