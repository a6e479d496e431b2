"""SQLite storage of rosbag2: a ``.db3`` file, with or without a write-ahead log next to it.

A damaged file is read up to the damage; ``sqlite3 .recover`` may restore the rest.
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
    make_ahead,
    ros_type_name,
)
from icrtool.records.text import LogText

SQLITE_MAGIC = b"SQLite format 3\0"
"""First bytes of a SQLite file."""

_WAL_AT = 18
"""Offset of the byte of a database that states whether it uses a write-ahead log."""

_IN_WAL_MODE = b"\2"
"""Value of this byte if the database uses a write-ahead log."""

_TABLES = frozenset({"topics", "messages", "message_definitions"})
_FUNCTIONS = frozenset({"group_concat", "length", "typeof", "max", "min", "count"})
"""Tables and functions of the queries of this module; SQLite refuses all others."""

_MOST_TOPICS = 1 << 17
"""Largest number of topics and definitions of a file that are read."""

_STEPS = 1 << 16
"""Number of steps of SQLite's virtual machine after which a query is asked whether to stop."""

_QUERY_STEPS = 1 << 26
"""Largest number of steps of SQLite's virtual machine for a query on an empty file. The pages of a damaged table may
refer to one another without end."""

_QUERY_STEPS_PER_BYTE = 16
"""Further number of steps that a query may take for each byte of the file."""

_FIRST_ROWS, _MOST_ROWS = 64, 1 << 14
"""First and largest number of rows that are read together."""

_GROUP_BYTES = 1 << 24
"""Size of the messages that are read together [bytes]."""

_LARGEST_MESSAGE_BYTES = 1 << 24
"""Largest size of a message that is read [bytes]. The messages that icrtool uses have a few kilobytes."""

_UNKNOWN_ROWS = 1 << 40
"""Number of rows that is assumed where the file does not show it."""

_DAMAGE = (sqlite3.Error, UnicodeDecodeError)
"""Errors of sqlite3 for a damaged file. The second one occurs if its message contains a damaged name."""


class SqliteBag(Container):
    """An open ``.db3`` file.

    Parameters
    ----------
    message_compression : compression of each single message, from rosbag2's metadata.yaml; empty if not known

    Raises
    ------
    LogError
        The file is no SQLite database, or no database of rosbag2.
    """

    def __init__(self, path: Path, message_compression: str = "") -> None:
        super().__init__(path, message_compression)
        self._file = path
        self._advice = f"`sqlite3 {path.name} .recover | sqlite3 recovered.db3` may restore more"
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
                # Serialised messages never begin with the first bytes of a zstd frame.
                if not message_compression and first and isinstance(first[0], bytes) and first[0][:4] == ZSTD_MAGIC:
                    self.message_compression = "zstd"
                last = self._first_row("SELECT max(rowid) FROM messages")
                self._rows = _UNKNOWN_ROWS if last is None else last[0] or 0
                if not isinstance(self._rows, int):
                    raise sqlite3.DatabaseError("its rows are not numbered")
                if not self._rows and (missing := self._missing_wal()):
                    self.report("log_damaged", f"it holds no message: {missing}")
            except BaseException:
                self.close()
                raise
        except _DAMAGE as err:
            if self._interruption is not None:
                raise self._interruption from None
            is_damaged = getattr(err, "sqlite_errorcode", None) == sqlite3.SQLITE_CORRUPT
            advice = self._missing_wal() or (self._advice if is_damaged else "")
            found = "; ".join(filter(None, [str(err), *(problem.sentence for problem in self.problems), advice]))
            raise LogError(path, "not a readable rosbag2 database", found) from err

    def _missing_wal(self) -> str:
        """Return a sentence if the write-ahead log is missing; empty if the file exists, or the database uses none."""
        log = self._file.with_name(f"{self._file.name}-wal")
        with self._file.open("rb") as file:
            uses_log = file.read(_WAL_AT + 1)[_WAL_AT:] == _IN_WAL_MODE
        if not uses_log or log.exists():
            return ""
        return f"its write-ahead log {log.name}, which holds messages, is missing: copy it into the same folder"

    def share_read(self) -> float:
        """Return the share of the rows that has been read, 0 to 1."""
        return self._last_row / max(self._rows, 1)

    def close(self) -> None:
        """Close the database, and remove the index file that SQLite made next to it."""
        self._database.close()
        if self._made_index is not None:
            self._made_index.unlink(missing_ok=True)
        super().close()

    def span_ns(self) -> tuple[int, int] | None:
        """Return the log times of the first and the last message [ns]; None where they cannot be read."""
        # SQLite uses its index of times only if each query asks for one of both.
        query = "SELECT {}(timestamp) FROM messages WHERE timestamp > 0"
        first, last = (self._first_row(query.format(which)) or (None,) for which in ("min", "max"))
        return (first[0], last[0]) if isinstance(first[0], int) and isinstance(last[0], int) else None

    def _yield_blocks(self, wanted: frozenset[int], cut: Cut) -> Iterator[MessageBlock]:
        """Yield the messages of the wanted topics in the order in which they were stored."""
        self._interruption = None

        def end_query() -> None:
            self._interruption = GeneratorExit()

        blocks: Iterator[MessageBlock] = make_ahead(self._in_order(wanted, cut), end_query)
        if lost := self._missing_page_bytes():
            blocks = _drop_last_bytes(blocks, lost)
        yield from blocks

    def _connect(self) -> sqlite3.Connection:
        """Return a read-only connection to the database, with the write-ahead log that a killed recorder left."""
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
            # SQLite refuses a file that is shorter than its header states. This pragma lets it read the existing pages.
            database.execute("PRAGMA writable_schema = ON")
        return database

    def _open(self, mode: str) -> sqlite3.Connection:
        """Return a connection to the database; `mode` is the query of its URI."""
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
            A table of the recorder is a view, a virtual table, or has computed columns; or the texts are not UTF-8.
        """
        query = "SELECT name, type FROM pragma_table_list WHERE schema = 'main' AND NOT wr"
        rows = self._database.execute(query).fetchmany(_MOST_TOPICS)
        types = {name: table_type for name, table_type in rows if name in _TABLES}
        for name, table_type in types.items():
            columns = self._database.execute(f"PRAGMA table_xinfo({name})").fetchall()
            if table_type != "table" or any(column[-1] for column in columns):
                raise sqlite3.DatabaseError(f"{name} is not a plain table")
        # The query of `_in_order` joins messages as texts, which works for UTF-8 alone.
        if (encoding := self._database.execute("PRAGMA encoding").fetchone()[0]) != "UTF-8":
            raise sqlite3.DatabaseError(f"its texts are {encoding}")
        self._tables = frozenset(types)
        self._database.set_authorizer(_allow)
        self._database.set_progress_handler(self._must_stop, _STEPS)

    def _must_stop(self) -> bool:
        """Return whether the running query has to stop: at its limit of steps, or after a signal.

        An exception that a signal raises here is kept, because SQLite would drop it.
        """
        try:
            self._steps_left -= _STEPS
        except BaseException as err:  # noqa: BLE001 - it is raised again where the query ends
            self._interruption = err
        return self._interruption is not None or self._steps_left < 0

    def _query(self, query: str, parameters: tuple[int, ...] = ()) -> sqlite3.Cursor:
        """Return the cursor of a query, which has its own limit of steps."""
        self._steps_left = _QUERY_STEPS + _QUERY_STEPS_PER_BYTE * self._file.stat().st_size
        return self._database.execute(query, parameters)

    def _first_row(self, query: str) -> tuple[Any, ...] | None:
        """Return the first row of the result of a query; None without a row, and where the row cannot be read."""
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
        """Yield the messages in the order in which they were stored, up to the first row that SQLite cannot read.

        Notes
        -----
        SQLite itself joins the messages of a batch, without a Python object for each message and without the
        interpreter lock. If the first query finds rows without a message, the second query reads the batch without
        these rows.
        """
        # The ids are integers from the database. As parameters, they could exceed SQLite's limit on variables.
        within, whole = (f"topic_id IN ({','.join(map(str, sorted(ids)))})" for ids in (wanted, cut.whole))
        after, stop = 0, self._rows
        if cut != WHOLE:
            inside = f"timestamp >= {cut.begin_ns} AND timestamp < {cut.end_ns}"
            if cut.whole:
                inside = f"({inside}) OR {whole}"
            # SQLite uses its index of times if the file has one.
            ends = self._first_row(f"SELECT min(rowid), max(rowid) FROM messages WHERE {inside}")  # noqa: S608
            if ends is not None:
                after, stop = (ends[0] - 1, ends[1]) if ends[0] is not None else (0, 0)
            within += f" AND ({inside})"
        # A column of SQLite may hold any type. Type and length of a message are known before it is read.
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
                # The damage may lie behind the first rows of the batch, or the rows are too long together.
                count //= 2
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
            # Each text has the ids, times or sizes of the messages, separated by commas.
            topics, times, sizes = (np.fromstring(text, np.int64, sep=",") for text in texts)
            end = np.cumsum(sizes)
            block = MessageBlock(np.frombuffer(content, np.uint8), topics, times, end - sizes, end)
            yield self._with_possible_times(block)
            by_size = _GROUP_BYTES * len(block.start) // max(len(block.data), 1)
            count = max(1, min(4 * count, _MOST_ROWS, by_size))

    def _missing_page_bytes(self) -> int:
        """Return the size of a page if the file ends inside a page, else 0 [bytes]; report a missing end."""
        size = self._file.stat().st_size
        with self._file.open("rb") as stream:
            head = stream.read(32)
        # In the field of two bytes, 1 stands for 65536.
        page_bytes = int.from_bytes(head[16:18], "big")
        page_bytes = page_bytes if page_bytes > 1 else 1 << 16
        if size % page_bytes or size < page_bytes * int.from_bytes(head[28:32], "big"):
            self.report("log_cut_off", f"cut off; the rows that SQLite can read were read; {self._advice}")
        return page_bytes if size % page_bytes else 0


def _allow(action: int, first: str | None, second: str | None, _: str | None, view: str | None) -> int:
    """Return whether SQLite may do an action, as its constant: read a table of `_TABLES`, call a function."""
    reads = action == sqlite3.SQLITE_READ and (first in _TABLES or not first) and view is None
    calls = action == sqlite3.SQLITE_FUNCTION and second in _FUNCTIONS
    return sqlite3.SQLITE_OK if reads or calls or action == sqlite3.SQLITE_SELECT else sqlite3.SQLITE_DENY


def _drop_last_bytes(blocks: Iterable[MessageBlock], lost: int) -> Iterator[MessageBlock]:
    """Yield blocks without the messages in their last `lost` bytes.

    Where a file ends inside a page, SQLite reads zeros in place of the missing bytes.
    """
    pending: deque[MessageBlock] = deque()
    size = 0
    for block in blocks:
        pending.append(block)
        size += len(block.data)
        while size - len(pending[0].data) >= lost:
            size -= len(pending[0].data)
            yield pending.popleft()
    for block in pending:
        yield block.rows(block.end <= size - lost)
        size -= len(block.data)
