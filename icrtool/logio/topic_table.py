"""A topic as columns: raw messages in, block by block; one table out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from icrtool.errors import DefinitionError
from icrtool.logio.channel import Block, Channel
from icrtool.logio.definitions import definitions_of
from icrtool.logio.layout import Definitions, Layout, compile_layout
from icrtool.logio.walk import walk_messages
from icrtool.tables import Ints

_FIRST_CAPACITY = 8
_LARGEST_CAPACITY = 256


@dataclass(frozen=True, slots=True)
class TopicTable:
    """All messages of one topic, in log-time order.

    Attributes
    ----------
    log_time_ns : int64 (n,)
    columns : by field path; float64 or int64, (n,) or, for an array field, (n, k), NaN or 0 where a message has less.
        A text field holds indices into `texts`.
    texts : the distinct texts of each text field
    unreadable : messages that did not have the shape of their type
    definition_source : where the message definition came from
    """

    topic: str
    message_type: str
    log_time_ns: Ints
    columns: dict[str, NDArray[Any]]
    texts: dict[str, list[str]]
    unreadable: int
    definition_source: str

    def __len__(self) -> int:
        return len(self.log_time_ns)

    def find(self, *paths: str) -> NDArray[Any] | None:
        """Return the first of these columns that the type has: drivers spell a field ``hAcc`` or ``h_acc``."""
        return next((self.columns[path] for path in paths if path in self.columns), None)

    def column(self, *paths: str) -> NDArray[Any]:
        """Return the first of these columns of numbers that the type has.

        Raises
        ------
        DefinitionError
            The type, as the log defines it, has none of them.
        """
        values = self.find(*(path for path in paths if path not in self.texts))
        if values is None:
            raise DefinitionError(self.topic, f"its {self.message_type} has no numbers {' or '.join(paths)}")
        return values

    def words(self, path: str) -> tuple[Ints, list[str]]:
        """Return a column of texts as indices (n,) or (n, k), -1 where a message has less, and the texts.

        Raises
        ------
        DefinitionError
            The type, as the log defines it, has no such field.
        """
        if path not in self.texts:
            raise DefinitionError(self.topic, f"its {self.message_type} has no text {path}")
        return self.columns[path], self.texts[path]

    def floats(self, *paths: str) -> NDArray[np.float64]:
        """Return the first of these columns as float64, NaN everywhere when the type has none."""
        values = self.find(*paths)
        return np.full(len(self), np.nan) if values is None else values.astype(np.float64)

    def rows(self, chosen: NDArray[np.bool_]) -> TopicTable:
        """Return the table of the chosen messages."""
        columns = {path: values[chosen] for path, values in self.columns.items()}
        return replace(self, log_time_ns=self.log_time_ns[chosen], columns=columns)

    def text(self, path: str) -> str:
        """Return the first text of a text field, empty when there is none."""
        texts = self.texts.get(path)
        return texts[0] if texts else ""


@dataclass(slots=True)
class TopicCollector:
    """Gathers the columns of one topic while blocks go by.

    Attributes
    ----------
    definitions : in place of the channel's own, None where those are used
    largest_capacity : elements taken of a sequence at most
    """

    channel: Channel
    wanted: tuple[str, ...]
    definitions: Definitions | None = None
    largest_capacity: int = _LARGEST_CAPACITY
    _capacity: int = _FIRST_CAPACITY
    _layout: Layout | None = None
    _source: str = ""
    _times: list[Ints] = field(default_factory=list)
    _parts: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    _texts: dict[str, dict[int, str]] = field(default_factory=dict)
    _unreadable: int = 0

    def __post_init__(self) -> None:
        self._compile()

    def _compile(self) -> None:
        definitions, self._source = definitions_of(self.channel)
        definitions = self.definitions if self.definitions is not None else definitions
        encoding = self.channel.encoding
        if encoding not in ("cdr", "ros1"):
            raise DefinitionError(self.channel.topic, f"serialization {encoding!r} is not read")
        self._layout = compile_layout(
            definitions, self.channel.message_type, self.wanted, cast(Literal["cdr", "ros1"], encoding), self._capacity
        )

    @property
    def layout(self) -> Layout:
        """The compiled layout."""
        if self._layout is None:
            raise ValueError("the layout is compiled when the collector is made")
        return self._layout

    def feed(self, block: Block, chosen: NDArray[np.bool_]) -> None:
        """Add the chosen messages of a block."""
        start, end = block.start[chosen], block.end[chosen]
        table, readable = walk_messages(self.layout, block.data, start, end)
        told = table if readable.all() else table[readable]
        most = max((int(told[:, column].max(initial=0)) for column in self.layout.count_columns), default=0)
        if self._capacity < min(most, self.largest_capacity):
            self._capacity = min(most, self.largest_capacity)
            self._compile()
            table, readable = walk_messages(self.layout, block.data, start, end)
            told = table if readable.all() else table[readable]
        self._unreadable += len(table) - len(told)
        self._times.append(block.log_time_ns[chosen][readable])
        for path, slot in self.layout.slots.items():
            values = self._codes(path, told, block) if slot.kind == "string" else self.layout.numbers(told, path)
            self._parts.setdefault(path, []).append(values)

    def _codes(self, path: str, table: NDArray[np.uint64], block: Block) -> NDArray[np.uint64]:
        """Return the hashes of a text field (n,) or (n, k); learn the texts that are new."""
        slot = self.layout.slots[path]
        texts = self._texts.setdefault(path, {})
        columns = []
        counts = self.layout.counts(table, path)
        for i in range(min(slot.repeat, int(counts.max(initial=0)))):
            at = slot.column + i * slot.stride
            codes = np.where(counts > i, table[:, at + 2], np.uint64(0))
            for code in np.unique(codes) if len(codes) and np.any(codes != codes[0]) else codes[:1]:
                if code and int(code) not in texts:
                    row = int(np.argmax(codes == code))
                    first, length = int(table[row, at]), int(table[row, at + 1])
                    texts[int(code)] = block.data[first : first + length].tobytes().decode("utf-8", "replace")
            columns.append(codes)
        if "[*]" not in path:
            return columns[0] if columns else np.zeros(len(table), np.uint64)
        return np.stack(columns, axis=1) if columns else np.zeros((len(table), 0), np.uint64)

    def table(self) -> TopicTable:
        """Return what was gathered since the last call, sorted by log time."""
        times = np.concatenate(self._times) if self._times else np.empty(0, np.int64)
        self._times.clear()
        order = np.argsort(times, kind="stable") if np.any(np.diff(times) < 0) else None
        columns: dict[str, NDArray[Any]] = {}
        texts: dict[str, list[str]] = {}
        unreadable, self._unreadable = self._unreadable, 0
        gathered, self._parts = self._parts, {}
        for path, parts in gathered.items():
            values = _joined(parts)
            parts.clear()
            if path in self._texts:
                values, texts[path] = _indexed(values, self._texts[path])
            columns[path] = values if order is None else values[order]
        return TopicTable(
            self.channel.topic,
            self.channel.message_type,
            times if order is None else times[order],
            columns,
            texts,
            unreadable,
            self._source,
        )


def merge_tables(tables: list[TopicTable]) -> list[TopicTable]:
    """Join tables of one topic and type: a ROS 1 bag gives each publisher a connection of its own."""
    groups: dict[tuple[str, str], list[TopicTable]] = {}
    for table in tables:
        groups.setdefault((table.topic, table.message_type), []).append(table)
    return [_merged(group) if len(group) > 1 else group[0] for group in groups.values()]


def _merged(group: list[TopicTable]) -> TopicTable:
    """Join tables of one topic and type, sorted by log time."""
    unreadable = sum(table.unreadable for table in group)
    group = [table for table in group if len(table)] or group[:1]
    times = np.concatenate([table.log_time_ns for table in group])
    order = np.argsort(times, kind="stable")
    columns: dict[str, NDArray[Any]] = {}
    texts: dict[str, list[str]] = {}
    # Publishers may have been built from different versions of the type: what all of them tell is kept.
    for path in group[0].columns:
        if any(path not in table.columns or (path in table.texts) != (path in group[0].texts) for table in group):
            continue
        parts = [table.columns[path] for table in group]
        if path in group[0].texts:
            texts[path] = list(dict.fromkeys(text for table in group for text in table.texts[path]))
            renumber = [np.array([*(texts[path].index(t) for t in table.texts[path]), -1]) for table in group]
            parts = [numbers[part] for numbers, part in zip(renumber, parts, strict=True)]
        columns[path] = _joined(parts, -1 if path in texts else 0)[order]
    return replace(group[0], log_time_ns=times[order], columns=columns, texts=texts, unreadable=unreadable)


def _joined(parts: list[NDArray[Any]], lacking: float = 0) -> NDArray[Any]:
    """Concatenate parts; those with fewer columns are padded with NaN, or with `lacking` where they hold integers."""
    if parts[0].ndim == 2:
        width = max(part.shape[1] for part in parts)
        lacking = np.nan if parts[0].dtype.kind == "f" else lacking
        parts = [
            np.pad(part, ((0, 0), (0, width - part.shape[1])), constant_values=lacking)
            if part.shape[1] < width
            else part
            for part in parts
        ]
    return np.concatenate(parts)


def _indexed(codes: NDArray[np.uint64], texts: dict[int, str]) -> tuple[Ints, list[str]]:
    """Turn hashes into indices of a list of texts; -1 where a message has no such element."""
    indices = np.full(codes.shape, -1, np.int64)
    for i, code in enumerate(texts):
        indices[codes == np.uint64(code)] = i
    return indices, list(texts.values())
