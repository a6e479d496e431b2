"""What the code of a finding means: its grade, cause, consequence and what to do."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

Grade = Literal["info", "warning", "grave"]

GRADES: tuple[Grade, ...] = get_args(Grade)
"""All grades, the least severe first."""


class Explanation(NamedTuple):
    """What a code means.

    Attributes
    ----------
    grade : grade of every finding with this code
    cause : what was found, and where it comes from
    consequence : the effect on the numbers
    action : what the user can do
    """

    grade: Grade
    cause: str
    consequence: str
    action: str
