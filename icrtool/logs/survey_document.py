"""What ``icrtool info --json`` prints of a log before it is fitted."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any

from icrtool.logs.read_log import Survey
from icrtool.records.samples import rate_and_jitter
from icrtool.records.tables import RobotLog


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
        "inputs": [asdict(file) for file in survey.inputs],
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
