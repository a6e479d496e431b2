"""Findings: what a log, a run, a report or a calibration shows that its user should know, as data.

A finding has a code, which programs compare; its text is for people, and no program searches in it. The codes, with
cause, consequence and what to do, are in `icrtool.records.note_catalogue` and in docs/warnings.md.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import msgspec

from icrtool.records.explanations import GRADES, Grade
from icrtool.records.note_catalogue import CATALOGUE
from icrtool.records.plain_data import Record

GRAVE: Grade = "grave"
"""Grade of a finding after which the numbers must not be used."""


_PARTS = re.compile("[:;] ")
"""Separators between the parts of a finding's text."""


class Note(Record, frozen=True):
    """One finding.

    Attributes
    ----------
    code : a key of `CATALOGUE`
    grade : ``info``: corrected, or of little consequence; ``warning``: numbers may be wrong; ``grave``: do not use them
    subject : name of the log or file that the finding is about; empty in a document about one log
    text : what was found with its numbers, what was done, and what the user can do
    """

    code: str
    grade: Grade
    subject: str
    text: str

    @property
    def sentence(self) -> str:
        """The name of the subject, a colon and the text; the text alone without a subject."""
        return f"{self.subject}: {self.text}" if self.subject else self.text

    @property
    def finding(self) -> str:
        """What was found, without what was done about it: the text up to its first colon or semicolon."""
        return _PARTS.split(self.text, maxsplit=1)[0]


def note(code: str, text: str, subject: str = "") -> Note:
    """Return a finding with the grade of its code.

    Raises
    ------
    KeyError
        The code is not in the catalogue.
    """
    # The name of a log is a `LogText`, which msgspec does not encode.
    return Note(code, CATALOGUE[code].grade, str.__str__(subject), str.__str__(text))


def notes_about(subject: str, notes: Iterable[Note]) -> tuple[Note, ...]:
    """Return the findings with `subject`, the name of a log or file, as their subject."""
    plain = str.__str__(subject)
    return tuple(msgspec.structs.replace(finding, subject=plain) for finding in notes)


def is_grave(note: Note) -> bool:
    """Return whether the numbers must not be used after a finding."""
    return note.grade == GRAVE


def warnings_of(notes: Iterable[Note]) -> tuple[str, ...]:
    """Return the sentences of the findings that are not grave; `unusable_because` returns the grave ones."""
    return tuple(finding.sentence for finding in notes if not is_grave(finding))


def unusable_because(notes: Iterable[Note]) -> str | None:
    """Return the texts of the grave findings in one line; None where there is none: the numbers may be used."""
    return "; ".join(finding.text for finding in notes if is_grave(finding)) or None


def first_to_read(notes: Sequence[Note]) -> Note | None:
    """Return the first finding of the highest grade below grave, None without one."""
    return next(iter(gravest(notes)), None)


def gravest(notes: Iterable[Note]) -> list[Note]:
    """Return the findings that are not grave, the highest grade first; findings of one grade keep their order."""
    shown = [finding for finding in notes if not is_grave(finding)]
    return sorted(shown, key=lambda finding: -GRADES.index(finding.grade))
