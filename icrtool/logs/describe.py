"""What a log holds before anything is chosen: its files, its topics, and the candidates of each role."""

from __future__ import annotations

import numpy as np

from icrtool.kernels.arrays import Ints
from icrtool.logs.streams.assembly import Survey
from icrtool.logs.streams.sources import Source
from icrtool.records.plain_data import Record
from icrtool.records.samples import InputFile, Role, rate_and_jitter

GAP_IN_INTERVALS, SHORTEST_GAP_S = 5.0, 0.1
"""A gap is longer than so many times the median interval, and than this."""


class SurveyedTopic(Record, frozen=True, kw_only=True):
    """A topic of a log.

    Attributes
    ----------
    messages : how many; None where nothing counts them
    read : whether it may have a role, so that its messages were read
    rate_hz : 1 / median interval; None where it was not read
    gaps : intervals far longer than the median, with the `longest_gap_s`
    unreadable : messages that do not fit their type
    not_read_because : of a type that has a role
    """

    topic: str
    message_type: str
    messages: int | None
    read: bool = False
    rate_hz: float | None = None
    gaps: int = 0
    longest_gap_s: float | None = None
    unreadable: int = 0
    not_read_because: str | None = None


class SurveyedSource(Record, frozen=True):
    """A candidate of a role; `problem`: why it cannot be used; `stamps`: what is known of its clock."""

    topic: str
    message_type: str
    why: str
    problem: str | None
    stamps: str


class SurveyDocument(Record, frozen=True):
    """What `icrtool info` states of a log as it lies there; `transfer`: how much came over a connection."""

    inputs: tuple[InputFile, ...]
    transfer: str | None
    topics: tuple[SurveyedTopic, ...]
    candidates: dict[Role, tuple[SurveyedSource, ...]]


def survey_document(survey: Survey) -> SurveyDocument:
    """Return the files of a log, its topics, and the candidates of each role with the reason for or against each."""
    roles = survey.candidates.by_role()
    return SurveyDocument(
        survey.inputs, survey.transfer or None, _topics(survey),
        {role: tuple(map(_source, sources)) for role, sources in roles.items()},
    )  # fmt: skip


def _topics(survey: Survey) -> tuple[SurveyedTopic, ...]:
    tables = {table.topic: table for table in survey.tables}
    found = []
    for channel in {channel.topic: channel for channel in survey.channels}.values():
        topic, kind, table = str(channel.topic), str(channel.message_type), tables.get(channel.topic)
        if table is None:
            why = survey.candidates.unread.get(channel.topic)
            found.append(SurveyedTopic(topic=topic, message_type=kind, messages=channel.count, not_read_because=why))
            continue
        gaps, longest_s = _gaps(table.log_time_ns)
        found.append(
            SurveyedTopic(
                topic=topic, message_type=kind, messages=len(table), read=True, gaps=gaps, longest_gap_s=longest_s,
                rate_hz=rate_and_jitter(table.log_time_ns)[0], unreadable=table.unreadable,
                not_read_because=survey.candidates.unread.get(channel.topic),
            )
        )  # fmt: skip
    return tuple(found)


def _gaps(stamps: Ints) -> tuple[int, float | None]:
    """Return how many intervals are far longer than the median, and the longest of them [s]; None without any."""
    if len(stamps) < 3:
        return 0, None
    interval = np.diff(stamps) / 1e9
    long = interval > max(GAP_IN_INTERVALS * float(np.median(interval)), SHORTEST_GAP_S)
    return int(np.count_nonzero(long)), float(interval.max()) if long.any() else None


def _source(one: Source) -> SurveyedSource:
    stamps = one.stamps.note or f"header stamps, {round(one.stamps.delay_ns / 1e6, 1) + 0.0:.1f} ms before log time"
    return SurveyedSource(str(one.topic), str(one.message_type), one.why, one.problem or None, stamps)
