"""Move the position reference, and the heading that comes with it, in time."""

from __future__ import annotations

from dataclasses import replace

from icrtool.records.tables import HeadingSamples, PositionFixes, RobotLog


def delayed(log: RobotLog, delay_s: float) -> RobotLog:
    """Return the log with the position reference taken `delay_s` earlier.

    The heading goes with it where both come from the same messages.
    """
    if delay_s == 0.0:
        return log
    shift = round(delay_s * 1e9)
    gnss: PositionFixes = replace(log.gnss, stamp_ns=log.gnss.stamp_ns - shift)
    topics = {stream.role: stream.topic for stream in log.streams}
    heading: HeadingSamples = log.heading
    if topics.get("gnss") == topics.get("heading", ""):
        heading = replace(heading, stamp_ns=heading.stamp_ns - shift)
    return replace(log, gnss=gnss, heading=heading)
