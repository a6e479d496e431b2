"""Output of `icrtool info`: an overview of a log and the next command; with -v every topic and candidate."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

import numpy as np

from icrtool.config import Config
from icrtool.errors import IcrToolError
from icrtool.logs.read_log import SurveyDocument, SurveyedTopic
from icrtool.logs.streams.wheel_pairs import topic_of_side
from icrtool.output.tables.run import LabelledLine, excitation_check, next_line, warnings_line
from icrtool.output.text_blocks import VERBOSE, Block, Facts, Section, Table
from icrtool.output.text_format import driven_text, duration_text
from icrtool.records.run import Run
from icrtool.records.samples import ROLE_WORDS
from icrtool.records.tables import RobotLog
from icrtool.records.text import counted, listed

OLDEST_DATE_NS = 946_684_800_000_000_000
"""Stamp of 1 January 2000 [ns]. Earlier stamps count from the start of a computer or a simulation."""


def overview_rows(log: RobotLog, run: Run | None) -> list[LabelledLine]:
    """Return date, duration, distance and extent of a log; the distance where it could be fitted."""
    stamps = [table.stamp_ns for table in (log.wheels, log.gnss, log.heading) if len(table.stamp_ns)]
    if not stamps:
        return []
    begin, end = min(int(column[0]) for column in stamps), max(int(column[-1]) for column in stamps)
    date = "at an unknown date (its stamps do not count from 1970)"
    if begin >= OLDEST_DATE_NS:
        date = datetime.fromtimestamp(begin / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
    rows = [("recorded", f"{date}, {duration_text((end - begin) / 1e9)}")]
    if run is not None:
        drive = run.document.drive
        rows.append(("driven", f"{driven_text(drive)}, {drive.speed_mean_mps:.2f} m/s on average"))
    fixes, datum = log.gnss, log.datum
    sound = np.isfinite(fixes.north_m) & np.isfinite(fixes.east_m)
    if sound.any():
        # Outliers are left out.
        ends = (np.percentile(column[sound], (0.1, 99.9)) for column in (fixes.east_m, fixes.north_m))
        east_m, north_m = (highest - lowest for lowest, highest in ends)
        where = " (metric positions)"
        if datum is not None:
            where = f" about {datum.latitude_deg:z.5f}°, {datum.longitude_deg:z.5f}°"
        rows.append(("area", f"{east_m:.1f} m east-west x {north_m:.1f} m north-south{where}"))
    return rows


def info_blocks(
    survey: SurveyDocument | None, log: RobotLog | None, run: Run | None, problem: IcrToolError | None,
    names: tuple[str, str], config: Config, command: str | None, scorable: Sequence[str] = (),
) -> list[Block]:  # fmt: skip
    """Return the output of `icrtool info`: verdict, drive, each topic once, what is missing, and the next command.

    Parameters
    ----------
    survey, log, run : results of reading and fitting; None for a step that failed. A table has no survey
    problem : the error because of which the log cannot be fitted
    names : name and path of the log, which stand before the problem where it is printed alone
    command : the command to run next
    scorable : topics with poses that are not the reference
    """
    decision, good = verdict(run, problem, names), run is not None and run.usable
    rows: list[LabelledLine] = []
    if survey is not None:
        size = sum(file.bytes for file in survey.inputs)
        topics, files = counted(len(survey.topics), "topic"), counted(len(survey.inputs), "file")
        rows += [("log", f"{names[0]}: {topics}, {size / 1e6:.3g} MB in {files}"), ("read", survey.transfer or "")]
    elif log is not None:
        rows.append(("log", f"{log.name}: table"))
    rows += overview_rows(log, run) if log is not None else []
    if run is not None:
        # Its advice is among the warnings.
        _, name, text, more = excitation_check(run.document)
        rows.append((name, "; ".join((text, *more))))
    rows += _topic_rows(survey, log)
    notes = run.notes if run is not None else log.notes if log is not None else ()
    rows.append(("warnings", warnings_line(notes)))
    if run is not None and config.robot.track_width_m is None:
        missing = (
            "robot.track_width_m (no multiplier, no no-slip odometry): --robot NAME (icrtool robots lists them), or "
            "--set robot.track_width_m=…"
        )
        rows.append(("missing", missing))
    if command and scorable:
        score = "dropout-report LOG --score TOPIC states how far such poses drift"
        rows.append(("poses", f"{listed(scorable, 3)} ({score})"))
    answer = Section("", [], lead=decision, label="verdict", grade="good" if good else "bad")
    return [answer, Facts(rows), next_line(command or ""), *_survey_sections(names[1], survey, log)]


def _topic_rows(survey: SurveyDocument | None, log: RobotLog | None) -> Iterator[LabelledLine]:
    """Yield each topic that is used, or the candidates closest to being usable, and the number of other topics."""
    used: set[str] = set()
    if log is not None:
        words: dict[str, list[str]] = {}
        for stream in log.streams:
            words.setdefault(stream.topic, []).append(ROLE_WORDS[stream.role])
        if log.gyro is not None:
            words.setdefault(log.gyro.topic, []).append("gyro")
        why: dict[str, str] = {}
        for stream in log.streams:
            rate = f"{stream.rate_hz:.4g} Hz; " if stream.rate_hz is not None else ""
            why.setdefault(stream.topic, rate + stream.why)
        for topic, (first, *more) in words.items():
            also = f" ({', '.join(more)} too)" if more else ""
            yield first, f"{topic}{also}: {why.get(topic, 'turn rates; not used by the filter')}"
        used |= words.keys()
    elif survey is not None:
        for role, sources in survey.candidates.items():
            used |= {sources[0].topic} if sources else set()
            text = next(
                (f"{source.topic}: {source.problem or source.why}" for source in sources), "no topic could be used"
            )
            yield ROLE_WORDS[role], text
    if survey is not None:
        others = {topic.topic for topic in survey.topics} - {
            topic_of_side(side) for name in used for side in name.split(" + ")
        }
        if others:
            yield "others", f"{counted(len(others), 'topic')} (-v names them, and why they are not used)"


def _survey_sections(path: str, survey: SurveyDocument | None, log: RobotLog | None) -> Iterator[Section]:
    """Yield each topic, the candidates of each role with the one that is used, and the time in which all overlap."""
    chosen = {stream.role: stream for stream in log.streams} if log is not None else {}
    if survey is not None:
        rows = [(topic.topic, topic.message_type, _topic_text(topic)) for topic in survey.topics]
        yield Section(f"Topics of {path}", [Table("l", rows) if rows else "  none"], VERBOSE)
    for role, word in ROLE_WORDS.items():
        stream, sources = chosen.get(role), survey.candidates[role] if survey is not None else ()
        blocks = ["  no candidate"] if survey is not None and not sources else []
        for source in sources:
            is_used = stream is not None and source.topic == stream.topic
            refused = "used although unsuitable, because it is configured" if is_used else "cannot be used"
            finding = f"{refused}: {source.problem}" if source.problem else source.why
            blocks.append(
                f"  {'*' if is_used else '-'} {source.topic} ({source.message_type}; {source.stamps}): {finding}"
            )
        if stream is not None:
            jitter = f", jitter {stream.jitter_ms:.3g} ms" if stream.jitter_ms is not None else ""
            blocks += [f"  -> {stream.topic}: {stream.why}"]
            blocks += [f"     {stream.samples_text} by {stream.clock} stamps{jitter}"]
        yield Section(f"{word} (key topics.{role}; * chosen)", blocks, VERBOSE)
    if log is None:
        return
    if (gyro := log.gyro) is not None:
        text = f"  -> {gyro.topic}: {len(gyro.stamp_ns)} turn rates, not used by the filter"
        yield Section("gyro", [text], VERBOSE)
    spans = [stream.stamp_ns for stream in (log.wheels, log.gnss, log.heading)]
    if all(map(len, spans)):
        overlap = (min(int(s[-1]) for s in spans) - max(int(s[0]) for s in spans)) / 1e9
        yield Section("", [f"all three overlap for {max(overlap, 0):.1f} s"], VERBOSE)


def _topic_text(topic: SurveyedTopic) -> str:
    """Return number, rate and gaps of the messages of a topic, or why the topic was not read."""
    if topic.not_read_because is not None and not topic.read:
        return f"not read: {topic.not_read_because}"
    parts = [] if topic.messages is None else [counted(topic.messages, "message")]
    if not topic.read:
        return ", ".join([*parts, "no role"])
    parts += [f"{topic.rate_hz:.4g} Hz"] if topic.rate_hz else []
    parts += [f"{counted(topic.gaps, 'gap')} up to {topic.longest_gap_s:.1f} s"] if topic.gaps else []
    return ", ".join([*parts, f"{topic.unreadable} unreadable"] if topic.unreadable else parts)


def verdict(run: Run | None, problem: IcrToolError | None, names: Sequence[str]) -> str:
    """Return in a sentence whether a log, of these names, can be fitted and used, and whether it shows the ICRs."""
    if run is None:
        return f"cannot be fitted: {problem.text_without(*names)}" if problem is not None else "cannot be fitted"
    if not run.usable:
        return f"not usable: {run.document.unusable_because}"
    shown = run.document.excitation.verdict.all_shown
    return f"can be fitted, {'all ICRs are shown' if shown else 'not all ICRs are shown'}"


def next_command(log: str, options: Sequence[str], run: Run | None) -> str | None:
    """Return the command to run next with a log, by the options of this one; None where it is of no use.

    Without a track width it has ``--robot NAME``, which stands for what the user has to give.
    """
    if run is None or not run.usable:
        return None
    options = [*options, *(() if run.document.config.robot.track_width_m is not None else ("--robot", "NAME"))]
    cut = "--from" in options or "--to" in options
    command = "fit" if cut else "report"
    return shlex.join(["icrtool", command, log, *options])
