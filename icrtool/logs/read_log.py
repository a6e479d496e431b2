"""Read a log: open it, read the columns of all candidates in one pass, choose, convert to the frames of `icrtool`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event
from typing import Literal

import numpy as np

from icrtool.config import Config
from icrtool.errors import DataError, DefinitionError
from icrtool.kernels.arrays import Ints
from icrtool.logs.containers.channel import WHOLE, Channel, Container, Cut
from icrtool.logs.containers.open_log import check_unchanged, open_log, states_of
from icrtool.logs.containers.split_files import log_name
from icrtool.logs.cut import Moment, cut_of, longest_part, moment
from icrtool.logs.messages.collectors import collector_for
from icrtool.logs.messages.topic_table import HEADER, TopicCollector, TopicTable
from icrtool.logs.streams.headings import GYRO_AXES, GYRO_TYPE, find_gyro, find_gyros
from icrtool.logs.streams.select import (
    Candidates,
    Choice,
    choose_streams,
    common_clock,
    fields_to_take,
    find_candidates,
    other_references,
)
from icrtool.logs.streams.sources import Convention, HeadingSource, PositionSource, WheelMotion
from icrtool.logs.streams.stamps import StampedRows, clock_notes, usable_rows
from icrtool.logs.streams.transforms import FIELDS, antenna_place, is_static, transform_channels, transform_pose
from icrtool.logs.streams.wheel_pairs import topic_of_side
from icrtool.logs.streams.wheel_speeds import ignored_joints, wheel_samples
from icrtool.logs.table_file import is_table, read_table
from icrtool.records.samples import (
    NO_HEADINGS,
    Datum,
    HeadingSamples,
    InputFile,
    OtherReceiver,
    PositionFixes,
    Role,
    StreamChoice,
    rate_and_jitter,
)
from icrtool.records.tables import RobotLog
from icrtool.records.text import LogText, escaped
from icrtool.records.urls import place_of

Progress = Callable[[float], None]


@dataclass(frozen=True, slots=True)
class Survey:
    """A log after one pass: its channels, all candidates, the messages that could not be read, its files.

    Attributes
    ----------
    tables : of their columns those that candidates do not hold: stamps, turn rates, static transforms
    transfer : how much came over a connection, in words; empty for a file on disk
    """

    name: LogText
    path: str
    channels: tuple[Channel, ...]
    tables: tuple[TopicTable, ...]
    candidates: Candidates
    problems: tuple[str, ...]
    inputs: tuple[InputFile, ...]
    transfer: str = ""


def survey_log(
    path: str | Path,
    config: Config | None = None,
    progress: Progress | None = None,
    *,
    start: Moment | None = None,
    end: Moment | None = None,
) -> Survey:
    """Read all candidate topics of a log.

    Parameters
    ----------
    path : a log as `open_log` knows them
    progress : called with the share of the log read so far, 0 to 1
    start, end : as `read_log` takes them

    Raises
    ------
    LogError
        The log cannot be opened, or was written to while it was read.
    """
    config = config if config is not None else Config()
    path = place_of(path) if isinstance(path, str) else path
    begin, stop = moment(start, "start"), moment(end, "end")
    before = states_of(path)
    container = open_log(path, progress)
    ended = Event()
    try:
        with ThreadPoolExecutor(1) as pool:
            try:
                inputs = pool.submit(container.inputs, ended)
                cut = cut_of(container, begin, stop, path)
                tables, unread = _collect(container, config, progress, cut)
                problems = tuple(container.problems)
                candidates = find_candidates(tables, config, unread)
                inputs.result()
            except BaseException:
                # The pool waits for its threads before it passes on Ctrl-C or an error.
                ended.set()
                raise
        channels, transfer = tuple(container.channels), container.transfer()
    finally:
        container.close()
    check_unchanged(path, before, inputs.result())
    drop_used_columns(tables)
    return Survey(
        name=LogText(log_name(path)),
        path=escaped(str(path)),
        channels=channels,
        tables=tuple(tables),
        candidates=candidates,
        problems=problems,
        inputs=inputs.result(),
        transfer=transfer,
    )


def drop_used_columns(tables: list[TopicTable]) -> None:
    """Remove the columns that only candidates were made of: half of what a log takes."""
    for table in tables:
        for name in table.columns.keys() - {*HEADER, *GYRO_AXES, *FIELDS}:
            del table.columns[name]


def read_log(
    path: str | Path,
    config: Config | None = None,
    progress: Progress | None = None,
    *,
    start: Moment | None = None,
    end: Moment | None = None,
) -> RobotLog:
    """Read wheels, position and heading of a log into tables.

    Parameters
    ----------
    path : ``.mcap``, ROS 1 ``.bag``, ROS 2 bag directory or ``.db3``, each also compressed or in an archive; ``-`` for
        standard input; an address (``s3://bucket/drive.mcap``); ``drive_{0..3}.bag`` for the files of a split
        recording; or a ``.csv`` of `icrtool.records.frames`, also compressed
    config : topics, robot and frames; default: all found by type and content
    progress : called with the share of the bytes that are read, 0 to 1
    start, end : read messages logged in [start, end) only: seconds since the log's first message, or a time of day:
        a `datetime` or ISO 8601 text, in UTC where it has no zone. Static transforms are read from all of the log.

    Raises
    ------
    LogError
        The log cannot be read, or was written to meanwhile.
    MissingStreamError
        No wheels or no position in it; a heading may be missing.
    ConfigError
        A configured topic that is not there, or a width or radius that is needed.
    DataError
        Streams without usable samples.
    """
    config = config if config is not None else Config()
    path = place_of(path) if isinstance(path, str) else path
    if is_table(path):
        return read_table(path, start, end)
    return assemble(survey_log(path, config, progress, start=start, end=end), config)


def assemble(survey: Survey, config: Config) -> RobotLog:
    """Return the log with its streams chosen and converted; errors as `read_log`."""
    choice = choose_streams(survey.candidates, config, survey.path, survey.channels)
    log = _assemble(survey, config, choice)
    others = []
    for other in other_references(survey.candidates, choice, config):
        # one that cannot be used is no alternative
        with contextlib.suppress(DataError):
            others.append(_assemble(survey, config, other))
    return replace(log, other_references=tuple(others)) if others else log


def _assemble(survey: Survey, config: Config, choice: Choice) -> RobotLog:
    """Return the log with the streams of a choice, converted."""
    found, name = survey.candidates, survey.name
    motion, position, source = choice.wheels, choice.gnss, choice.heading
    delays = [
        s.stamps.delay_ns / 1e9 if s.stamps.header_ns is not None else None
        for s in (motion, position, source)
        if s is not None
    ]
    clock = common_clock(delays)
    warnings = list(survey.problems)
    if clock == "log" and any(delay is not None for delay in delays):
        warnings.append(
            f"{name}: one stream has no header stamps, and the header stamps of another are far from log time; "
            "log time is used for all streams"
        )
    chosen: tuple[tuple[Role, WheelMotion | PositionSource | HeadingSource | None], ...]
    chosen = (("wheels", motion), ("gnss", position), ("heading", source))
    warnings += clock_notes([(role, one.stamps) for role, one in chosen if one is not None], name)
    gnss, datum, rejected = _fixes(position, config, clock, name)
    heading, convention = (NO_HEADINGS, "") if source is None else _headings(source, config, clock, name)
    samples, wheel_warnings = wheel_samples(motion, motion.stamps.on(clock), config, name)
    warnings += wheel_warnings
    warnings += [f"{name}: {ignored}" for ignored in ignored_joints(motion, config)]
    warnings += [f"{name}: {one.topic}: {one.note}" for one in (motion, source) if one is not None and one.note]
    if source is None:
        warnings += [f"{name}: {one.topic} gives no heading: {one.problem}" for one in found.heading]
    antenna = antenna_place(survey.tables, position.topic)
    quantity = "position" if samples.from_position else "speed"
    streams: tuple[StreamChoice, ...] = (
        _stream("wheels", motion, samples.stamp_ns, clock, f"{choice.why['wheels']}; {quantity}"),
        _stream("gnss", position, gnss.stamp_ns, clock, f"{choice.why['gnss']}{_place_in_words(antenna)}"),
    )
    if source is not None:
        streams += (_stream("heading", source, heading.stamp_ns, clock, f"{choice.why['heading']}; {convention}"),)
    unreadable: dict[str, int] = {table.topic: table.unreadable for table in survey.tables if table.unreadable}
    warnings += [
        f"{name}: {topic}: {unreadable[topic]} messages do not fit their message type; left out"
        for topic in dict.fromkeys(topic_of_side(name) for stream in streams for name in stream.topic.split(" + "))
        if topic in unreadable
    ]
    stamps: dict[str, StampedRows] = {one.topic: one.stamps for one in found.heading if one.message_type == GYRO_TYPE}
    gyro = find_gyro(survey.tables, motion.topic, "" if source is None else source.topic, clock, stamps)
    log = RobotLog(
        name, samples, gnss, heading, datum, streams, survey.inputs, rejected, tuple(warnings), antenna, gyro,
        find_gyros(survey.tables, clock, stamps),
        _other_receivers(survey.candidates, position, datum, config, clock, name),
    )  # fmt: skip
    return longest_part(log)


def _other_receivers(
    found: Candidates,
    chosen: PositionSource,
    datum: Datum | None,
    config: Config,
    clock: Literal["header", "log"],
    name: str,
) -> tuple[OtherReceiver, ...]:
    """Return the fixes of the other GNSS receivers, in the local plane of the chosen one."""
    if datum is None:
        return ()
    return tuple(
        OtherReceiver(source.topic, _fixes(source, config, clock, name, datum)[0])
        for source in found.gnss
        if source is not chosen and source.geodetic is not None and source.usable.any() and not source.problem
    )


def _place_in_words(antenna: tuple[float, float] | None) -> str:
    if antenna is None:
        return ""
    return f"; antenna {antenna[0]:+.2f} m forward, {antenna[1]:+.2f} m right of the base (/tf_static)"


def _collect(
    container: Container, config: Config, progress: Progress | None, cut: Cut
) -> tuple[list[TopicTable], dict[str, str]]:
    """Return the columns of all channels that some role may need, read in one pass over the log."""
    unread: dict[str, str] = {}
    collectors: dict[int, TopicCollector | None] = {}
    by_topic: dict[tuple[str, str], TopicCollector] = {}
    by_id = {channel.id: channel for channel in container.channels}
    topics = {channel.id: (channel.topic, channel.message_type) for channel in container.channels}
    wanted = fields_to_take(container.channels, config)
    static = {channel.id: FIELDS for channel in container.channels if is_static(channel)}
    moving = transform_channels(container.channels, config.topics)
    wanted |= static | moving
    cut = cut._replace(whole=frozenset(static)) if cut != WHOLE else cut
    with contextlib.closing(container.blocks(frozenset(wanted), cut)) as blocks:
        for whole in blocks:
            block = cut.of(whole)
            numbers = np.sort(block.channel)  # np.unique takes four times as long
            for number in numbers[np.diff(numbers, prepend=-1) > 0].tolist():
                if number not in wanted:
                    continue
                try:
                    if number not in collectors:
                        # A definition is compiled when its first message comes: a log may declare any number of topics.
                        collectors[number] = None
                        before = by_topic.get(topics[number])
                        by_topic[topics[number]] = collector_for(by_id[number], wanted[number], before)
                        collectors[number] = by_topic[topics[number]]
                    if (collector := collectors[number]) is not None:
                        collector.feed(block, number)
                except DefinitionError as err:
                    unread[by_id[number].topic] = str(err)
            if progress is not None:
                progress(container.share_read())
    for number in wanted.keys() - collectors.keys():
        by_topic.setdefault(topics[number], TopicCollector(by_id[number]))
    tables = [
        by_topic[topic].table() for topic in dict.fromkeys(topics[number] for number in wanted) if topic in by_topic
    ]
    for place, table in enumerate(tables):
        if table.topic in {by_id[number].topic for number in moving} and len(table):
            try:
                tables[place] = transform_pose(table)
            except DefinitionError as err:
                unread[table.topic] = err.why
    return tables, unread


def _stream(
    role: Role,
    source: WheelMotion | PositionSource | HeadingSource,
    stamps: Ints,
    clock: Literal["header", "log"],
    why: str,
) -> StreamChoice:
    rows = source.stamps
    rate, jitter = rate_and_jitter(stamps)
    used: Literal["header", "log"] = "header" if clock == "header" and rows.header_ns is not None else "log"
    return StreamChoice(role, source.topic, source.message_type, len(stamps), rate, used, jitter, why)


def _fixes(
    source: PositionSource, config: Config, clock: Literal["header", "log"], name: str, given: Datum | None = None
) -> tuple[PositionFixes, Datum | None, dict[str, int]]:
    """Return positions in the local plane about the datum: `given`, else the configured one, else the first fix."""
    if not source.usable.any():
        raise DataError(name, f"{source.topic}: {source.problem}", "name another position in topics.gnss")
    stamps = source.stamps.on(clock)
    rows = np.flatnonzero(source.usable)
    rows = rows[np.argsort(stamps[rows], kind="stable")]
    datum = None
    if source.geodetic is not None:
        from pymap3d import geodetic2ned

        latitude, longitude, height = source.geodetic[rows].T
        if given is not None:
            datum = given
        elif config.frames.datum is not None:
            datum = Datum(*config.frames.datum, float(height[0]))
        else:
            datum = Datum(float(latitude[0]), float(longitude[0]), float(height[0]))
        north, east, _ = geodetic2ned(
            latitude, longitude, height, datum.latitude_deg, datum.longitude_deg, datum.height_m
        )
    else:
        north, east = np.asarray(source.metric, np.float64)[rows].T
    var_north, var_east, covariance = (np.ascontiguousarray(column) for column in source.variance[rows].T)
    fixes = PositionFixes(
        stamps[rows],
        np.ascontiguousarray(north, np.float64),
        np.ascontiguousarray(east, np.float64),
        var_north,
        var_east,
        covariance,
        stated_class=None if source.stated_class is None else source.stated_class[rows],
    )
    return fixes, datum, dict(source.rejected)


def _headings(
    source: HeadingSource, config: Config, clock: Literal["header", "log"], name: str
) -> tuple[HeadingSamples, str]:
    """Return headings clockwise from north, and a text on how the convention is known."""
    if not source.usable.any():
        raise DataError(
            name, f"{source.topic}: {source.problem or 'no usable heading'}", "choose another with topics.heading"
        )
    convention: Convention = source.convention
    why = source.convention_why
    if config.frames.heading != "auto":
        convention, why = config.frames.heading, "configured"
    stamps = source.stamps.on(clock)
    rows = usable_rows(stamps, source.usable)
    samples = HeadingSamples(stamps[rows], source.heading_rad(convention)[rows], source.variance[rows])
    return samples, f"{convention.upper()} ({why})"
