"""What every topic that may feed a role has: its stamps, how suitable it is, and why it cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from icrtool.kernels.arrays import Bools, Bytes, Floats
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


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionSource(Source):
    """Positions of one topic.

    Attributes
    ----------
    geodetic : (n, 3) latitude, longitude [deg], ellipsoidal height [m]; None where metric
    metric : (n, 2) north, east [m] in the topic's own frame; None where geodetic
    variance : (n, 3) north, east, covariance of both [m^2]; NaN where not stated
    usable : (n,) rows to use; `rejected` counts the others by reason
    stated_class : uint8 (n,) how the position was solved, None where no message states it
    """

    geodetic: Floats | None = None
    metric: Floats | None = None
    variance: Floats = field(default_factory=lambda: np.empty((0, 3)))
    usable: Bools = field(default_factory=lambda: NO_ROWS)
    rejected: dict[str, int] = field(default_factory=dict)
    stated_class: Bytes | None = None

    @property
    def is_empty(self) -> bool:
        """Whether no row can be used, even where the topic is configured."""
        return not self.usable.any()


PositionEntry = tuple[tuple[str, ...], Callable[[TopicTable], PositionSource]]
"""The fields of a message type to take, and how to read them."""


def of_topic(table: TopicTable, stamp: str = "header.stamp") -> dict[str, Any]:
    """Return what a source has of its topic; `stamp` is the field of its stamps."""
    return {"topic": table.topic, "message_type": table.message_type, "stamps": stamp_rows(table, stamp)}
