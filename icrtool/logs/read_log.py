"""Read a log: open it, read the columns of all candidates in one pass, choose, convert to the frames of `icrtool`."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Event

import numpy as np

from icrtool.config import Config
from icrtool.errors import DefinitionError
from icrtool.logs.containers.channel import WHOLE, Cut
from icrtool.logs.containers.container import Container
from icrtool.logs.containers.open_log import check_unchanged, open_log, states_of
from icrtool.logs.containers.recording_files import log_name
from icrtool.logs.cut import Moment, cut_of, moment
from icrtool.logs.messages.collectors import collector_for
from icrtool.logs.messages.topic_table import HEADER, TopicCollector, TopicTable
from icrtool.logs.streams.assembly import Survey, assemble
from icrtool.logs.streams.headings import GYRO_AXES
from icrtool.logs.streams.select import fields_to_take, find_candidates
from icrtool.logs.streams.transforms import FIELDS, is_static, transform_channels, transform_pose
from icrtool.logs.table_file import is_table, read_table
from icrtool.records.tables import RobotLog
from icrtool.records.text import LogText, escaped
from icrtool.records.urls import place_of

Progress = Callable[[float], None]


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
