"""Reader of logs: all candidates are read in one pass, the topics are chosen, and their samples converted.

A log may also be a CSV file (columns: `icrtool.RobotLog.from_frames`). `survey_document` returns the content of a log
before topics are chosen, which `icrtool info` prints.
"""

from __future__ import annotations

import contextlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from threading import Event

import numpy as np

from icrtool.config import Config
from icrtool.errors import DataError, DefinitionError, LogError
from icrtool.kernels.arrays import Bools, Floats
from icrtool.logs.containers.container import LATEST_NS, WHOLE, Channel, Container, Cut, folded_ns
from icrtool.logs.containers.open_log import check_unchanged, open_log, plain_file, states_of
from icrtool.logs.containers.recording_files import PACKED_SUFFIX, log_name
from icrtool.logs.csv_table import csv_frame
from icrtool.logs.messages.definition_bounds import DefinitionBudget
from icrtool.logs.messages.definitions import definition_note
from icrtool.logs.messages.topic_table import TopicCollector, TopicTable, collector_for
from icrtool.logs.streams.assembly import Survey, assemble, longest_part
from icrtool.logs.streams.positions import TRANSFORM_TYPES, is_static, transform_pose
from icrtool.logs.streams.repeats import find_repeats, first_pass
from icrtool.logs.streams.select import find_candidates, wanted_fields
from icrtool.records.notes import note
from icrtool.records.places import UrlPath, place_of
from icrtool.records.plain_data import Record
from icrtool.records.samples import InputFile, Role, rate_and_jitter
from icrtool.records.tables import RobotLog
from icrtool.records.text import LogText, escaped

Progress = Callable[[float], None]

Moment = float | str | datetime
"""Type of a moment: seconds since the first message of the log, or date and time as `datetime` or ISO 8601 text."""

_CSV_NAME = re.compile(rf"\.csv(?:{PACKED_SUFFIX})?$", re.IGNORECASE)


def survey_log(
    path: str | Path,
    config: Config | None = None,
    progress: Progress | None = None,
    *,
    start: Moment | None = None,
    end: Moment | None = None,
) -> Survey:
    """Return the content of all candidate topics of a log.

    Parameters
    ----------
    path : path or address of a log, as for `read_log`, but no table
    config : the configuration
    progress : called with the share of the log that has been read, 0 to 1
    start, end : as for `read_log`

    Raises
    ------
    LogError
        The log cannot be opened, or was written to while it was read.
    DataError
        The end is not after the start, or no message lies between them.
    """
    config = config if config is not None else Config()
    path = place_of(path)
    begin, stop = read_moment(start, "start"), read_moment(end, "end")
    states_before = states_of(path)
    ended = Event()
    with contextlib.closing(open_log(path, progress)) as container, ThreadPoolExecutor(1) as pool:
        try:
            inputs = pool.submit(container.inputs, ended)
            cut = cut_of(container, begin, stop, path)
            tables, unread = _collect(container, config, progress, cut)
            problems = tuple(container.problems)
            candidates = find_candidates(tables, config, unread)
            inputs.result()
        except BaseException:
            # The pool waits for its threads before Ctrl-C or an error reaches the caller, so that they must end soon.
            ended.set()
            raise
        channels, transfer = tuple(container.channels), container.transfer()
    check_unchanged(path, states_before, inputs.result())
    names = LogText(log_name(path)), escaped(str(path))
    return Survey(*names, channels, tuple(tables), candidates, problems, inputs.result(), transfer)


def read_log(
    path: str | Path,
    config: Config | None = None,
    progress: Progress | None = None,
    *,
    start: Moment | None = None,
    end: Moment | None = None,
) -> RobotLog:
    """Return wheels, position and heading of a log as tables.

    Parameters
    ----------
    path : ``.mcap``, ROS 1 ``.bag``, ROS 2 bag directory or ``.db3``, each also compressed or in an archive; ``-`` for
        standard input; an address (``s3://bucket/drive.mcap``); ``drive_{0..3}.bag`` for the files of a split
        recording; or a ``.csv`` with the columns of `icrtool.RobotLog.from_frames`, also compressed
    config : topics, robot and frames; default: all found by type and content
    progress : called with the share of the bytes that are read, 0 to 1
    start, end : only messages with log times in [start, end) are read. A moment is a number of seconds since the first
        message of the log, or date and time as `datetime` or ISO 8601 text, in UTC if it has no zone. Static transforms
        are read from the whole log

    Raises
    ------
    LogError
        The log cannot be read, or was written to while it was read.
    MissingStreamError
        The log has no wheels or no position. A heading may be missing.
    ConfigError
        A configured topic is not in the log, or a needed width or radius is not configured.
    DataError
        A stream has no usable samples.
    """
    config = config if config is not None else Config()
    path = place_of(path)
    if is_table(path):
        return read_table(path, start, end)
    return assemble(survey_log(path, config, progress, start=start, end=end), config)


def _collect(
    container: Container, config: Config, progress: Progress | None, cut: Cut
) -> tuple[list[TopicTable], dict[str, str]]:
    """Return the tables of all channels that may have a role, read in one pass, and the reasons for unread topics."""
    wanted = wanted_fields(container.channels, config)
    static = frozenset(channel.id for channel in container.channels if is_static(channel))
    cut = cut._replace(whole=static) if cut != WHOLE else cut
    tables, unread = collect_tables(container, wanted, cut, progress)
    if (repeats := find_repeats(tables)) is not None:
        container.report("recording_looped", repeats.text)
        tables = [first_pass(table, repeats) for table in tables]
    by_id = {channel.id: channel for channel in container.channels}
    moving = {number for number in wanted if by_id[number].message_type in TRANSFORM_TYPES} - static
    poses = {by_id[number].topic for number in moving}
    for index, table in enumerate(tables):
        if table.topic in poses and len(table):
            try:
                tables[index] = transform_pose(table)
            except DefinitionError as err:
                unread[table.topic] = err.why
    return tables, unread


def collect_tables(
    container: Container, wanted: Mapping[int, tuple[str, ...]], cut: Cut = WHOLE, progress: Progress | None = None
) -> tuple[list[TopicTable], dict[str, str]]:
    """Return the tables of some channels, read in one pass, and for each unreadable topic the reason.

    Parameters
    ----------
    container : the opened log
    wanted : paths of the fields to read, by channel id
    cut : part of the log that is read
    progress : called with the share of the log that has been read, 0 to 1
    """
    unread: dict[str, str] = {}
    collectors: dict[int, TopicCollector | None] = {}
    by_topic: dict[tuple[str, str], TopicCollector] = {}
    budget = DefinitionBudget()
    by_id = {channel.id: channel for channel in container.channels}
    topics = {channel.id: (channel.topic, channel.message_type) for channel in container.channels}
    with contextlib.closing(container.blocks(frozenset(wanted), cut)) as blocks:
        for uncut_block in blocks:
            block = cut.apply(uncut_block)
            # np.unique takes four times as long as sorting.
            channel_ids = np.sort(block.channel)
            for channel_id in channel_ids[np.diff(channel_ids, prepend=-1) > 0].tolist():
                if channel_id not in wanted:
                    continue
                try:
                    if channel_id not in collectors:
                        # A definition is compiled at its first message, because a log may declare any number of topics.
                        collectors[channel_id] = None
                        earlier_table = by_topic.get(topics[channel_id])
                        by_topic[topics[channel_id]] = collector_for(
                            by_id[channel_id], wanted[channel_id], earlier_table, budget
                        )
                        collectors[channel_id] = by_topic[topics[channel_id]]
                    if (collector := collectors[channel_id]) is not None:
                        collector.feed(block, channel_id)
                except DefinitionError as err:
                    unread[by_id[channel_id].topic] = str(err)
            if progress is not None:
                progress(container.share_read())
    _report_definitions(
        container, [by_id[channel_id] for channel_id, collector in collectors.items() if collector is not None]
    )
    for channel_id in wanted.keys() - collectors.keys():
        by_topic.setdefault(topics[channel_id], TopicCollector(by_id[channel_id]))
    in_order = dict.fromkeys(topics[channel_id] for channel_id in wanted)
    tables = [by_topic[topic].table() for topic in in_order if topic in by_topic]
    return tables, unread


def _report_definitions(container: Container, channels: Sequence[Channel]) -> None:
    """Report each channel that is read with a bundled definition because the definition in the log is damaged."""
    for channel in channels:
        if note := definition_note(channel):
            container.report("definition_bundled", f"{channel.topic}: {note}; the bundled definition is used")


def read_moment(moment: Moment | None, key: str) -> float | datetime | None:
    """Return a moment as seconds since the first message of the log, or as a `datetime` with a zone.

    Parameters
    ----------
    key : name of the moment in errors: ``start`` or ``end``

    Raises
    ------
    LogError
        The moment is neither a finite number nor a time in ISO 8601.
    """
    if isinstance(moment, str):
        text = moment
        with contextlib.suppress(ValueError):
            moment = float(text)
        try:
            moment = datetime.fromisoformat(text) if isinstance(moment, str) else moment
        except ValueError as err:
            why = f"{text!r} is neither a number of seconds nor a time in ISO 8601"
            raise LogError(key, why, "for example 12.5, or 2026-05-04T09:30:00") from err
    if moment is None or isinstance(moment, datetime):
        return moment if moment is None or moment.tzinfo is not None else moment.replace(tzinfo=UTC)
    if not math.isfinite(moment):
        raise LogError(key, f"{moment} is not a number of seconds")
    return float(moment)


def cut_of(container: Container, start: float | datetime | None, end: float | datetime | None, log: Path) -> Cut:
    """Return the part of a log between two moments.

    Parameters
    ----------
    container : the opened log
    start, end : results of `read_moment`; None: begin or end of the log
    log : path of the log in errors

    Raises
    ------
    DataError
        The end is not after the start, or no message lies between them.
    """
    if start is None and end is None:
        return WHOLE
    first, span = 0, container.span_ns()
    # The container converts log times beyond LATEST_NS in the same manner.
    if span is not None and span[0] >= LATEST_NS:
        span = folded_ns(span[0]), folded_ns(span[1])
    if isinstance(start, float) or isinstance(end, float):
        if span is not None:
            first = span[0]
        else:
            # Without an index, all messages are read to find the first time.
            blocks = container.blocks(frozenset(channel.id for channel in container.channels))
            first = min((int(block.log_time_ns.min()) for block in blocks if len(block.log_time_ns)), default=0)
    begin_ns = max(log_time_of(start, first), 0) if start is not None else 0
    end_ns = log_time_of(end, first) if end is not None else LATEST_NS
    if begin_ns >= end_ns:
        raise DataError(log, "the part to read ends before it begins", "give an end later than the start")
    if span is not None and (begin_ns > span[1] or end_ns <= span[0]):
        begun, lasts_s = np.datetime64(span[0] // 10**9, "s"), (span[1] - span[0]) / 1e9
        raise DataError(
            log, "the part to read holds no message", f"the log begins at {begun}Z and lasts {lasts_s:.1f} s"
        )
    return Cut(begin_ns, min(end_ns, LATEST_NS))


def log_time_of(moment: float | datetime, first_ns: int) -> int:
    """Return a moment as log time [ns]; `first_ns` is the log time of the first message."""
    if isinstance(moment, datetime):
        passed = moment - datetime(1970, 1, 1, tzinfo=UTC)
        return (passed.days * 86_400 + passed.seconds) * 1_000_000_000 + passed.microseconds * 1000
    return first_ns + round(max(min(moment, 1e9), -1e9) * 1e9)


def is_table(path: Path) -> bool:
    """Return whether a path or an address names a CSV table, by its suffix."""
    return _CSV_NAME.search(path.name) is not None and (path.is_file() or isinstance(path, UrlPath))


def read_table(path: Path, start: Moment | None = None, end: Moment | None = None) -> RobotLog:
    """Return the log in a CSV file, also compressed, which has a row for each stamp.

    Parameters
    ----------
    path : path of the CSV file
    start, end : as for `read_log`

    Raises
    ------
    LogError
        The file is no CSV table.
    DataError
        A column is missing, or holds a value that is not a number.
    """
    import pandas as pd

    begin, stop = read_moment(start, "start"), read_moment(end, "end")
    states_before = states_of(path)
    try:
        with plain_file(path) as (file, read):
            table = csv_frame(file)
        check_unchanged(path, states_before, [read])
    except OSError as err:
        raise LogError(path, "cannot be read", err.strerror or str(err)) from err
    except ValueError as err:
        raise LogError(path, "not a CSV table", str(err)) from err
    form = table.attrs.get("form", "")
    table = table.rename(columns=str)
    if begin is not None or stop is not None:
        clock, unit = ("stamp_ns", 1) if "stamp_ns" in table else ("t_s", 1e9)
        if clock in table and len(table):
            stamps = pd.to_numeric(table[clock], errors="coerce") * unit
            inside = np.isfinite(stamps)
            first = int(stamps[inside].min()) if inside.any() else 0
            inside &= stamps >= log_time_of(begin, first) if begin is not None else True
            inside &= stamps < log_time_of(stop, first) if stop is not None else True
            table = table[inside]
    log = RobotLog.from_frames(table, table, table, table, log_name(path))
    notes = (note("table_form", f"read with {form}", log.name),) if form else ()
    return longest_part(replace(log, inputs=(read,), notes=(*log.notes, *notes)))


TOPIC_GAP_IN_INTERVALS = 5.0
"""Shortest gap between messages of a topic, as a multiple of their median interval."""

SHORTEST_GAP_S = 0.1
"""Shortest gap between messages of a topic [s]."""


def long_intervals(interval_s: Floats) -> Bools:
    """Return a mask of the intervals between messages (n,) [s] that are gaps; a single interval is no gap."""
    if len(interval_s) < 2:
        return np.zeros(len(interval_s), np.bool_)
    return np.asarray(interval_s > max(TOPIC_GAP_IN_INTERVALS * float(np.median(interval_s)), SHORTEST_GAP_S))


class SurveyedTopic(Record, frozen=True, kw_only=True):
    """A topic of a log.

    Attributes
    ----------
    messages : number of messages; None where it is not known
    read : whether the messages were read, because the topic may have a role
    rate_hz : 1 / median interval between messages; None for a topic that was not read
    gaps : number of gaps between messages
    longest_gap_s : longest gap [s]; None without a gap
    unreadable : number of messages that do not fit their type
    not_read_because : reason why a topic with a type for a role was not read; None for other topics
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
    """A candidate for a role.

    Attributes
    ----------
    why : text about its data and score
    problem : reason why it cannot be used; None for a usable candidate
    stamps : text about the clock of its stamps
    """

    topic: str
    message_type: str
    why: str
    problem: str | None
    stamps: str


class SurveyDocument(Record, frozen=True):
    """Content of a log before topics are chosen, for `icrtool info`.

    Attributes
    ----------
    inputs : files of the log
    transfer : text about the data that was transferred over a connection; None for a file on disk
    topics : all topics of the log
    candidates : candidates for each role, the best one first
    """

    inputs: tuple[InputFile, ...]
    transfer: str | None
    topics: tuple[SurveyedTopic, ...]
    candidates: dict[Role, tuple[SurveyedSource, ...]]


def survey_document(survey: Survey) -> SurveyDocument:
    """Return the files of a log, its topics, and the candidates of each role with the reason for or against each."""
    tables = {table.topic: table for table in survey.tables}
    topics = []
    for channel in {channel.topic: channel for channel in survey.channels}.values():
        table = tables.get(channel.topic)
        stamps = np.empty(0, np.int64) if table is None else table.log_time_ns
        interval = np.diff(stamps) / 1e9
        is_gap = long_intervals(interval)
        topics.append(
            SurveyedTopic(
                topic=str(channel.topic), message_type=str(channel.message_type),
                messages=channel.count if table is None else len(table), read=table is not None,
                rate_hz=rate_and_jitter(stamps)[0], gaps=int(np.count_nonzero(is_gap)),
                longest_gap_s=float(interval.max()) if is_gap.any() else None,
                unreadable=0 if table is None else table.unreadable,
                not_read_because=survey.candidates.unread.get(channel.topic),
            )
        )  # fmt: skip
    candidates: dict[Role, tuple[SurveyedSource, ...]] = {}
    for role, sources in survey.candidates.by_role().items():
        found = []
        for source in sources:
            delay = f"{source.stamps.delay_ns / 1e6:z.1f} ms"
            clock = source.stamps.note or f"header stamps, {delay} before log time"
            found.append(
                SurveyedSource(str(source.topic), str(source.message_type), source.why, source.problem or None, clock)
            )
        candidates[role] = tuple(found)
    return SurveyDocument(survey.inputs, survey.transfer or None, tuple(topics), candidates)
