"""rosbag2's sqlite3 storage: one ``.db3`` file, with or without a write-ahead log next to it.

A damaged file is read up to the damage; ``sqlite3 .recover`` may bring back the rest.
"""

from __future__ import annotations

import os
import sqlite3
from collections import deque
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from icrtool.errors import LogError
from icrtool.logs.containers.chunk import ZSTD_MAGIC
from icrtool.logs.containers.container import (
    WHOLE,
    Channel,
    Container,
    Cut,
    MessageBlock,
    made_ahead,
    ros_type_name,
)
from icrtool.records.text import LogText

SQLITE_MAGIC = b"SQLite format 3\0"
_WAL_AT = 18
"""Offset, from the start of a database, of the byte that states whether it uses a write-ahead log."""

_IN_WAL_MODE = b"\2"
"""Value of this byte where the database uses a write-ahead log."""

_TABLES = frozenset({"topics", "messages", "message_definitions"})
_FUNCTIONS = frozenset({"group_concat", "length", "typeof", "max", "min", "count"})
"""The tables, columns and functions that our queries use; SQLite refuses everything else."""

_MOST_TOPICS = 1 << 17
_STEPS = 1 << 16
"""Number of steps of SQLite's virtual machine between two checks whether to stop."""

_QUERY_STEPS = 1 << 26
"""Largest number of steps of SQLite's virtual machine for a query on an empty file. The pages of a damaged table may
refer to one another without end."""

_QUERY_STEPS_PER_BYTE = 16
"""Number of steps that a query may take in addition for each byte of the file."""

_FIRST_ROWS, _MOST_ROWS = 64, 1 << 14
_GROUP_BYTES = 1 << 24
"""Number of bytes of messages that are read together."""

_LARGEST_MESSAGE_BYTES = 1 << 24
"""Largest size of a message that is read [bytes]. Messages that icrtool uses have some kilobytes."""

_UNKNOWN_ROWS = 1 << 40
_DAMAGE = (sqlite3.Error, UnicodeDecodeError)
"""The errors of sqlite3; the latter where its message contains a damaged name."""


class SqliteBag(Container):
    """One ``.db3`` file.

    Parameters
    ----------
    message_compression : compression of each single message, from rosbag2's metadata.yaml; empty if not known

    Raises
    ------
    LogError
        Not an SQLite file, or not a file of rosbag2.
    """

    def __init__(self, path: Path, message_compression: str = "") -> None:
        super().__init__(path, message_compression)
        self._file = path
        self._advice = f"`sqlite3 {path.name} .recover | sqlite3 recovered.db3` may bring back more"
        self._made_index: Path | None = None
        self._last_row = 0
        self._steps_left = 0
        self._interruption: BaseException | None = None
        try:
            self._database = self._connect()
            try:
                self._restrict()
                self.channels = self._read_topics()
                first = self._first_row("SELECT data FROM messages LIMIT 1")
                # Serialised data never begins like compressed data.
                if not message_compression and first and isinstance(first[0], bytes) and first[0][:4] == ZSTD_MAGIC:
                    self.message_compression = "zstd"
                last = self._first_row("SELECT max(rowid) FROM messages")
                self._rows = _UNKNOWN_ROWS if last is None else last[0] or 0
                if not isinstance(self._rows, int):
                    raise sqlite3.DatabaseError("its rows are not numbered")
                if not self._rows and (lacking := self._lacking_log()):
                    self.report("log_damaged", f"it holds no message: {lacking}")
            except BaseException:
                self.close()
                raise
        except _DAMAGE as err:
            if self._interruption is not None:
                raise self._interruption from None
            is_damaged = getattr(err, "sqlite_errorcode", None) == sqlite3.SQLITE_CORRUPT
            advice = self._lacking_log() or (self._advice if is_damaged else "")
            found = "; ".join(filter(None, [str(err), *(one.sentence for one in self.problems), advice]))
            raise LogError(path, "not a readable rosbag2 database", found) from err

    def _lacking_log(self) -> str:
        """Return in words that the write-ahead log of a database is missing; empty if it is there, or none is used."""
        log = self._file.with_name(f"{self._file.name}-wal")
        with self._file.open("rb") as file:
            is_ahead = file.read(_WAL_AT + 1)[_WAL_AT:] == _IN_WAL_MODE
        if not is_ahead or log.exists():
            return ""
        return f"its write-ahead log {log.name} is missing, in which a recorder keeps messages: copy it to its folder"

    def share_read(self) -> float:
        """Return the last row read as a share of all rows."""
        return self._last_row / max(self._rows, 1)

    def close(self) -> None:
        """Release the database; no new file stays next to it."""
        self._database.close()
        if self._made_index is not None:
            self._made_index.unlink(missing_ok=True)
        super().close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return the times of the first and the last message, None where they cannot be read."""
        # one query each: SQLite takes both from its index of times then
        query = "SELECT {}(timestamp) FROM messages WHERE timestamp > 0"
        first, last = (self._first_row(query.format(which)) or (None,) for which in ("min", "max"))
        return (first[0], last[0]) if isinstance(first[0], int) and isinstance(last[0], int) else None

    def _stored(self, wanted: frozenset[int], cut: Cut) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted topics in the order they were stored."""
        self._interruption = None

        def end_query() -> None:
            self._interruption = GeneratorExit()

        blocks: Iterator[MessageBlock] = made_ahead(self._in_order(wanted, cut), end_query)
        if lost := self._cut_inside_page():
            blocks = _without_last(blocks, lost)
        yield from blocks

    def _connect(self) -> sqlite3.Connection:
        """Open the database to read, with the write-ahead log that a recorder leaves when it is killed."""
        log, index = (self._file.with_name(self._file.name + end) for end in ("-wal", "-shm"))
        if log.exists() and log.stat().st_size:
            self._made_index = None if os.path.lexists(index) else index
            database = self._open("mode=ro")
            try:
                database.execute("SELECT name FROM sqlite_master")
            except _DAMAGE as err:
                database.close()
                self.report(
                    "log_part_unreadable",
                    f"its write-ahead log cannot be read ({err}); the last messages may be missing",
                )
            else:
                return database
        # Without `immutable` SQLite writes files next to a log that was recorded in WAL mode.
        database = self._open("mode=ro&immutable=1")
        try:
            database.execute("SELECT name FROM sqlite_master")
        except _DAMAGE:
            # SQLite refuses a file that is shorter than its header states. With this it reads the pages that are there.
            database.execute("PRAGMA writable_schema = ON")
        return database

    def _open(self, mode: str) -> sqlite3.Connection:
        name = quote(os.fsencode(self._file.resolve()))
        database = sqlite3.connect(f"file:{name}?{mode}", uri=True, check_same_thread=False)
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, 2 * _GROUP_BYTES)
        database.text_factory = lambda text: text.decode("utf-8", "replace")
        return database

    def _restrict(self) -> None:
        """Allow queries on plain tables only, limit their time, and stop them when the program has to end.

        Raises
        ------
        sqlite3.DatabaseError
            A table of a recorder is a view, a virtual table, or has computed columns; or texts are not UTF-8.
        """
        query = "SELECT name, type FROM pragma_table_list WHERE schema = 'main' AND NOT wr"
        kinds = {name: kind for name, kind in self._database.execute(query).fetchmany(_MOST_TOPICS) if name in _TABLES}
        for name, kind in kinds.items():
            columns = self._database.execute(f"PRAGMA table_xinfo({name})").fetchall()
            if kind != "table" or any(column[-1] for column in columns):
                raise sqlite3.DatabaseError(f"{name} is not a plain table")
        if (encoding := self._database.execute("PRAGMA encoding").fetchone()[0]) != "UTF-8":
            raise sqlite3.DatabaseError(f"its texts are {encoding}")  # messages are joined as texts
        self._tables = frozenset(kinds)
        self._database.set_authorizer(_allow)
        self._database.set_progress_handler(self._look_up, _STEPS)

    def _look_up(self) -> bool:
        """Return whether the running query has to stop. Signals are handled here: SQLite would lose them."""
        try:
            self._steps_left -= _STEPS
        except BaseException as err:  # noqa: BLE001 - it is raised again where the query ends
            self._interruption = err
        return self._interruption is not None or self._steps_left < 0

    def _query(self, query: str, parameters: tuple[int, ...] = ()) -> sqlite3.Cursor:
        """Run a query, with its own limit of steps."""
        self._steps_left = _QUERY_STEPS + _QUERY_STEPS_PER_BYTE * self._file.stat().st_size
        return self._database.execute(query, parameters)

    def _first_row(self, query: str) -> tuple[Any, ...] | None:
        """Return the first row that a query finds, None where there is none, or it cannot be read."""
        try:
            row: tuple[Any, ...] | None = self._query(query).fetchone()
        except _DAMAGE:
            return None
        return row

    def _read_topics(self) -> list[Channel]:
        tables = self._tables
        if not {"topics", "messages"} <= tables:
            raise sqlite3.DatabaseError(f"its tables are {', '.join(sorted(map(str, tables))) or 'none'}")
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            try:
                stored = self._query(query).fetchmany(_MOST_TOPICS)
                definitions = {name: (encoding, str(text)) for name, encoding, text in stored}
            except _DAMAGE as err:
                self.report("log_part_unreadable", f"its message definitions cannot be read ({err})")
        channels = []
        # A log may declare any number of topics; types and encodings are few.
        type_named, text = cache(ros_type_name), cache(LogText)
        for number, topic, name, encoding in self._query(
            "SELECT id, name, type, serialization_format FROM topics WHERE typeof(id) = 'integer' ORDER BY id"
        ).fetchmany(_MOST_TOPICS):
            written, definition = definitions.get(name, ("", ""))
            channels.append(
                Channel(
                    id=number,
                    topic=LogText(str(topic)),
                    message_type=type_named(str(name)),
                    encoding=text(str(encoding)),
                    definition=definition if written in ("ros2msg", "ros2idl") else "",
                    definition_format="idl" if written == "ros2idl" else "msg",
                )
            )
        return channels

    def _in_order(self, wanted: frozenset[int], cut: Cut) -> Iterator[MessageBlock]:
        """Yield the messages in the order they were stored, up to the first row that SQLite cannot read.

        Notes
        -----
        SQLite joins the messages of a batch itself, without one Python object for each and without the interpreter
        lock. If the first query finds rows without a message, the second query reads the batch without these rows.
        """
        # The ids are integers from the database itself; as parameters they could exceed SQLite's limit of variables.
        within, whole = (f"topic_id IN ({','.join(map(str, sorted(some)))})" for some in (wanted, cut.whole))
        after, stop = 0, self._rows
        if cut != WHOLE:
            inside = f"timestamp >= {cut.begin_ns} AND timestamp < {cut.end_ns}"
            if cut.whole:
                inside = f"({inside}) OR {whole}"
            # by the index of times, if any
            ends = self._first_row(f"SELECT min(rowid), max(rowid) FROM messages WHERE {inside}")  # noqa: S608
            if ends is not None:
                after, stop = (ends[0] - 1, ends[1]) if ends[0] is not None else (0, 0)
            within += f" AND ({inside})"
        # A column may hold any type. Type and length of a message are known without reading it.
        sound = "typeof(topic_id) = 'integer' AND typeof(timestamp) = 'integer' AND typeof(data) = 'blob'"
        sound += f" AND length(data) <= {_LARGEST_MESSAGE_BYTES}"
        joined, of_sound = (
            "SELECT group_concat(topic), group_concat(time), group_concat(length(data)), "  # noqa: S608
            "CAST(group_concat(data, '') AS BLOB), max(number), count(*) - count(data) FROM (SELECT topic_id AS topic, "
            f"timestamp AS time, CASE WHEN {sound} THEN data END AS data, rowid AS number FROM messages "
            f"WHERE {rows} AND rowid > ? ORDER BY rowid LIMIT ?)"
            for rows in (within, f"{within} AND {sound} AND rowid <= ?")
        )
        count = _FIRST_ROWS
        while after < stop:
            try:
                *texts, content, last, without = self._query(joined, (after, count)).fetchone()
                if without:
                    *texts, content, _, _ = self._query(of_sound, (last, after, count)).fetchone()
            except _DAMAGE as err:
                if self._interruption is not None:
                    raise self._interruption from None
                if count == 1:
                    self.report("log_damaged", f"damaged ({err}); the rows before the damage were read; {self._advice}")
                    return
                count //= 2  # to read the rows before the damage, or fewer of very long rows
                continue
            if last is None:
                return
            self._last_row = after = max(after + 1, last)
            if without:
                self.report(
                    "log_damaged",
                    f"rows without a time, or without a message of up to {_LARGEST_MESSAGE_BYTES} bytes, left out",
                )
            if content is None:
                continue
            # ids, times and sizes, with commas between
            topics, times, sizes = (np.fromstring(text, np.int64, sep=",") for text in texts)
            end = np.cumsum(sizes)
            block = MessageBlock(np.frombuffer(content, np.uint8), topics, times, end - sizes, end)
            yield self._with_possible_times(block)
            by_size = _GROUP_BYTES * len(block.start) // max(len(block.data), 1)
            count = max(1, min(4 * count, _MOST_ROWS, by_size))

    def _cut_inside_page(self) -> int:
        """Return the bytes of a page where the file ends inside one, else 0; and report an end that is missing."""
        size = self._file.stat().st_size
        with self._file.open("rb") as stream:
            head = stream.read(32)
        # The field has two bytes, and 1 stands for 65536.
        page_bytes = int.from_bytes(head[16:18], "big")
        page_bytes = page_bytes if page_bytes > 1 else 1 << 16
        if size % page_bytes or size < page_bytes * int.from_bytes(head[28:32], "big"):
            self.report("log_cut_off", f"cut off; the rows that SQLite can read were read; {self._advice}")
        return page_bytes if size % page_bytes else 0


def _allow(action: int, first: str | None, second: str | None, _: str | None, view: str | None) -> int:
    """Return whether SQLite may do an action: reading a recorder's tables and calling a few functions is allowed."""
    reads = action == sqlite3.SQLITE_READ and (first in _TABLES or not first) and view is None
    calls = action == sqlite3.SQLITE_FUNCTION and second in _FUNCTIONS
    return sqlite3.SQLITE_OK if reads or calls or action == sqlite3.SQLITE_SELECT else sqlite3.SQLITE_DENY


def _without_last(blocks: Iterable[MessageBlock], lost: int) -> Iterator[MessageBlock]:
    """Yield blocks without the messages in their last bytes: SQLite reads zeros behind the end of a page cut off."""
    held: deque[MessageBlock] = deque()
    size = 0
    for block in blocks:
        held.append(block)
        size += len(block.data)
        while size - len(held[0].data) >= lost:
            size -= len(held[0].data)
            yield held.popleft()
    for block in held:
        yield block.rows(block.end <= size - lost)
        size -= len(block.data)
