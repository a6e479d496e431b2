"""What ``icrtool info`` states of a log before it is fitted: as text, and as JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from icrtool.kernels.arrays import Ints
from icrtool.logs.streams.assembly import Survey
from icrtool.logs.streams.sources import Source
from icrtool.records.plain_data import plain
from icrtool.records.samples import ROLE_WORDS, StreamChoice, rate_and_jitter
from icrtool.records.tables import RobotLog
from icrtool.records.text import counted

GAP_IN_INTERVALS = 5.0


def describe_survey(survey: Survey, measured: RobotLog | None) -> str:
    """Return the text of ``icrtool info -v``: topics, rates, gaps, stamps, candidates by role, the choice.

    Parameters
    ----------
    measured : the assembled log, None when it cannot be used
    """
    size = sum(file.bytes for file in survey.inputs)
    topics, files = counted(len(survey.channels), "topic"), counted(len(survey.inputs), "file")
    lines = [f"{survey.path}: {topics}, {size / 1e6:.3g} MB in {files}"]
    lines += [f"  {survey.transfer}"] if survey.transfer else []
    lines += _topics(survey)
    chosen = {stream.role: stream for stream in measured.streams} if measured is not None else {}
    for role, sources in survey.candidates.by_role().items():
        lines.append(f"\n{ROLE_WORDS[role]} (key topics.{role}; * chosen):")
        lines += _candidates(sources, chosen[role].topic if role in chosen else None)
        if role in chosen:
            stream = chosen[role]
            lines.append(f"  -> {stream.topic}: {stream.why}")
            lines.append(f"     {stream.samples_text} by {stream.clock} stamps{_jitter(stream)}")
    if measured is not None and measured.gyro is not None:
        gyro = measured.gyro
        lines.append(f"\ngyro:\n  -> {gyro.topic}: {len(gyro.stamp_ns)} turn rates, not used by the filter")
    spans = [one.stamp_ns for one in (measured.wheels, measured.gnss, measured.heading)] if measured is not None else []
    if spans and all(map(len, spans)):
        overlap = (min(int(s[-1]) for s in spans) - max(int(s[0]) for s in spans)) / 1e9
        lines.append(f"\nall three overlap for {max(overlap, 0):.1f} s")
    return "\n".join(lines)


def describe_log(log: RobotLog) -> str:
    """Return the text of ``icrtool info`` for a log that is a table."""
    lines = [f"{log.name}: table"]
    for stream in log.streams:
        samples = f"{stream.samples_text}{_jitter(stream)}"
        lines.append(f"  {ROLE_WORDS[stream.role]}: {stream.topic}: {samples}; {stream.why}")
    return "\n".join(lines)


def _jitter(stream: StreamChoice) -> str:
    return f", jitter {stream.jitter_ms:.3g} ms" if stream.jitter_ms is not None else ""


def _topics(survey: Survey) -> list[str]:
    tables = {table.topic: table for table in survey.tables}
    lines, width = [], max((len(str(channel.topic)) for channel in survey.channels), default=0)
    for topic, channel in {channel.topic: channel for channel in survey.channels}.items():
        table = tables.get(topic)
        text = f"  {topic:<{width}}  {channel.message_type}"
        if table is not None:
            rate, _ = rate_and_jitter(table.log_time_ns)
            text += f"  {counted(len(table), 'message')}{f', {rate:.4g} Hz' if rate else ''}{_gaps(table.log_time_ns)}"
            if table.unreadable:
                text += f", {table.unreadable} unreadable"
        elif topic in survey.candidates.unread:
            text += f"  not read: {survey.candidates.unread[topic]}"
        elif channel.count is not None:
            text += f"  {counted(channel.count, 'message')}, no role"
        else:
            text += "  no role"
        lines.append(text)
    return lines


def _gaps(stamps: Ints) -> str:
    """Return a text: how many intervals are far longer than the median, and the longest [s]; empty for none."""
    if len(stamps) < 3:
        return ""
    interval = np.diff(stamps) / 1e9
    long = interval > max(GAP_IN_INTERVALS * float(np.median(interval)), 0.1)
    if not long.any():
        return ""
    return f", {counted(int(np.count_nonzero(long)), 'gap')} up to {float(interval.max()):.1f} s"


def _candidates(sources: Sequence[Source], chosen: str | None) -> list[str]:
    if not sources:
        return ["  no candidate"]
    lines = []
    for source in sources:
        mark = "*" if source.topic == chosen else "-"
        clock = (
            source.stamps.note
            or f"header stamps, {round(source.stamps.delay_ns / 1e6, 1) + 0.0:.1f} ms before log time"
        )
        refused = "used although unsuitable, because it is configured" if source.topic == chosen else "cannot be used"
        verdict = f"{refused}: {source.problem}" if source.problem else source.why
        lines.append(f"  {mark} {source.topic} ({source.message_type}; {clock}): {verdict}")
    return lines


def survey_document(survey: Survey) -> dict[str, Any]:
    """Return the files of a log, its topics, and the candidates of each role with the reason for or against each."""
    tables = {table.topic: table for table in survey.tables}
    topics = []
    for channel in {channel.topic: channel for channel in survey.channels}.values():
        table = tables.get(channel.topic)
        rate_hz = rate_and_jitter(table.log_time_ns)[0] if table is not None else None
        topics.append(
            {
                "topic": str(channel.topic),
                "message_type": str(channel.message_type),
                "messages": len(table) if table is not None else channel.count,
                "rate_hz": rate_hz,
                "unreadable": table.unreadable if table is not None else 0,
                "not_read_because": survey.candidates.unread.get(channel.topic),
            }
        )
    return {
        "inputs": plain(survey.inputs),
        "transfer": survey.transfer or None,
        "topics": topics,
        "candidates": {
            role: [
                {
                    "topic": str(one.topic),
                    "message_type": str(one.message_type),
                    "why": one.why,
                    "problem": one.problem or None,
                }
                for one in sources
            ]
            for role, sources in survey.candidates.by_role().items()
        },
    }


def streams_document(log: RobotLog) -> list[dict[str, Any]]:
    """Return the topic that each role uses, and why."""
    return [asdict(stream) for stream in log.streams]
