"""What every topic that may feed a role has: its stamps, how suitable it is, and why it cannot be used."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from icrtool.kernels.arrays import Bools
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.stamps import StampedRows, stamp_rows

NEVER_MOVES = 60.0
"""Subtracted from the score of what never moves: another topic that moves is preferred."""

NO_ROWS: Bools = np.zeros(0, np.bool_)


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A topic, or a pair of topics, that may feed a role; of one that cannot be read the subclass holds no values.

    Attributes
    ----------
    score : how suitable the type is; why : the reason as text
    problem : why it cannot be used, empty when it can
    """

    topic: str
    message_type: str
    stamps: StampedRows
    score: float = 0.0
    why: str = ""
    problem: str = ""


def of_topic(table: TopicTable, stamp: str = "header.stamp") -> dict[str, Any]:
    """Return what a source has of its topic; `stamp` is the field of its stamps."""
    return {"topic": table.topic, "message_type": table.message_type, "stamps": stamp_rows(table, stamp)}
