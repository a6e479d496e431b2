"""Tables with the messages of one topic as columns, which are gathered block by block.

Each channel of a topic has a decoder, which is chosen by message type and serialization.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Ints
from icrtool.logs.containers.container import Channel, MessageBlock
from icrtool.logs.messages.decoded_values import NMEA_SENTENCE, SentenceDecoder, ValueDecoder, value_decoder
from icrtool.logs.messages.decoder import Decoded, Decoder, ros_decoder
from icrtool.logs.messages.definition_bounds import DefinitionBudget
from icrtool.records.text import LogText

_MOST_EXPECTED = 1 << 22
"""Largest number of values for which a column reserves memory by the number of messages that the log states."""

_MESSAGES_AT_ONCE = 1 << 14
"""Largest number of messages that are decoded together."""

LARGEST_VALUE = 1e30
"""Largest finite value of a column, in any unit. A larger number becomes infinite, so that squares and cubes of finite
numbers do not overflow."""


class GrowingColumn:
    """Column of a table to which rows are added; while all rows are equal, it holds one of them.

    Parameters
    ----------
    fill : value of the missing elements of a row that is shorter than others, for integers; NaN for floats
    """

    def __init__(self, fill: int) -> None:
        self._fill = fill
        self._count = 0
        self._values: NDArray[Any] = np.empty(0, np.int64)

    def add(self, new_rows: NDArray[Any], expected: int) -> None:
        """Add a copy of rows (m,) or (m, k); `expected` is the total number of rows that the log states."""
        before, held = self._count, self._values
        self._count += len(new_rows)
        row = _single_row(new_rows) if len(held) <= 1 else None
        if before == 0 and row is not None:
            self._values = row
        elif row is None or len(held) > 1 or row.shape != held.shape or row.tobytes() != held.tobytes():
            width = max(new_rows.shape[1:], held.shape[1:])
            dtype = np.result_type(new_rows, held) if before else new_rows.dtype
            added = [(before, new_rows)]
            if before == 0 or len(held) < self._count or width > held.shape[1:] or dtype != held.dtype:
                likely = min(expected, _MOST_EXPECTED // max(*width, 1, 1))
                self._values = np.empty((*width, max(2 * before, self._count, likely)), dtype).T
                if before:
                    old = held[:before] if len(held) > 1 else np.broadcast_to(held, (before, *held.shape[1:]))
                    added.insert(0, (0, old))
            for begin, values in added:
                rows = self._values[begin : begin + len(values)]
                if values.ndim == 2 and values.shape[1] < rows.shape[1]:
                    rows[:, values.shape[1] :] = np.nan if rows.dtype.kind == "f" else self._fill
                    rows = rows[:, : values.shape[1]]
                _copy(values, rows)

    def rows(self) -> NDArray[Any]:
        """Return all rows (n,) or (n, k); read-only if all rows are equal."""
        values = self._values
        return values[: self._count] if len(values) > 1 else np.broadcast_to(values, (self._count, *values.shape[1:]))


def _single_row(rows: NDArray[Any]) -> NDArray[Any] | None:
    """Return the first row (1,) or (1, k) if all rows equal it bit by bit; None if they differ or there is no row."""
    bits = rows.view(np.int64)
    if len(rows) == 0 or (rows.strides[0] and ((bits[-1] != bits[0]).any() or (bits != bits[0]).any())):
        return None
    row = np.empty_like(rows[:1])
    _copy(rows[:1], row)
    return row


def _copy(source: NDArray[Any], target: NDArray[Any]) -> None:
    """Copy numbers; a signalling NaN becomes a quiet NaN, and a number beyond `LARGEST_VALUE` infinite."""
    if target.dtype.kind != "f":
        target[...] = source
        return
    # The copy comes first, because source and target may differ in the order of their memory.
    target[...] = source
    with np.errstate(invalid="ignore"):
        np.multiply(target, 1.0, out=target)
    # A comparison with NaN is false.
    if target.size and not (target.min() >= -LARGEST_VALUE and target.max() <= LARGEST_VALUE):
        np.copyto(target, np.copysign(np.inf, target), where=np.abs(target) > LARGEST_VALUE)


class BackwardStep(NamedTuple):
    """The largest step back of log time between successive messages in the file.

    The steps back divide the messages into stretches. Sorting by log time cuts a stretch into pieces where messages of
    other stretches come between its messages.

    Attributes
    ----------
    step_ns : size of the largest step back [ns]
    pieces : mean number of pieces of a stretch: 1 where only the order of the stretches changes, about 2 where single
        messages are out of place, many where the same times occur twice
    before_ns : log time of the last message before the largest step [ns]
    """

    step_ns: int
    pieces: float
    before_ns: int = 0


NO_BACKWARD_STEP = BackwardStep(0, 0.0)
"""Log times that do not go back."""

FRAME_FIELD = "header.frame_id"
"""Field with the name of the coordinate frame of a message."""

STAMPS = (("header.stamp.sec", "header.stamp.nanosec"), ("stamp.sec", "stamp.nanosec"))
"""Fields of the stamp of a message: in its header, and in a message without a header."""

HEADER = (*STAMPS[0], FRAME_FIELD, *STAMPS[1])
"""Fields of the header of a message, which are read from every topic."""

DISORDER_NS = 2_000_000_000
"""Largest step back of log time that a recorder makes by storing messages out of order [ns]. A larger step shows that a
clock was set; a header stamp that is further from log time is of another clock."""

OUT_OF_ORDER_NS = 200_000_000
"""Usual limit of the steps back of log time within one topic [ns]."""


@dataclass(frozen=True, slots=True)
class TopicTable:
    """All messages of one topic, in the order of their log times.

    Attributes
    ----------
    topic, message_type : name of the topic, and type of its messages
    log_time_ns : (n,) int64, times at which the recorder received the messages
    columns : values by the path of their field: float64 or int64, (n,), or (n, k) for an array, with NaN or 0 where a
        message has fewer elements. The column of a text field holds indices into `texts`
    texts : the distinct texts of each text field
    unreadable : number of messages that do not fit their type; they are not in the table
    backward_step : largest step back of log time in the file
    """

    topic: LogText
    message_type: LogText
    log_time_ns: Ints
    columns: dict[str, NDArray[Any]]
    texts: dict[str, list[LogText]]
    unreadable: int
    backward_step: BackwardStep = NO_BACKWARD_STEP

    def __len__(self) -> int:
        return len(self.log_time_ns)

    def find(self, *paths: str) -> NDArray[Any] | None:
        """Return the first of these columns that the type has as numbers, None without one.

        Several paths are given where drivers spell a field differently, as ``hAcc`` and ``h_acc``.
        """
        return next((self.columns[path] for path in paths if path in self.columns and path not in self.texts), None)

    def integers(self, *paths: str) -> Ints | None:
        """Return the first of these columns that the type has; None without one, and where it has no whole numbers."""
        values = self.find(*paths)
        return values if values is not None and values.dtype.kind == "i" else None

    def column(self, *paths: str) -> NDArray[Any]:
        """Return the first of these columns that the type has as numbers.

        Raises
        ------
        DefinitionError
            The type, as the log defines it, has no such column.
        """
        values = self.find(*paths)
        if values is None:
            raise DefinitionError(self.topic, f"its type {self.message_type} has no numeric field {' or '.join(paths)}")
        return values

    def words(self, path: str) -> tuple[Ints, list[LogText]]:
        """Return a text field as indices (n,) or (n, k) into the texts, -1 where a message lacks one, and the texts.

        Raises
        ------
        DefinitionError
            The type, as the log defines it, has no such text field.
        """
        if path not in self.texts:
            raise DefinitionError(self.topic, f"its type {self.message_type} has no text field {path}")
        return self.columns[path], self.texts[path]

    def floats(self, *paths: str) -> NDArray[np.float64]:
        """Return the first of these columns that the type has as float64; NaN without one. It may be read-only."""
        values = self.find(*paths)
        return np.full(len(self), np.nan) if values is None else values.astype(np.float64, copy=False)

    def rows(self, chosen: NDArray[np.bool_] | Ints) -> TopicTable:
        """Return a table of some messages, chosen by a mask (n,) or by their rows (m,)."""
        columns = {path: values[chosen] for path, values in self.columns.items()}
        return replace(self, log_time_ns=self.log_time_ns[chosen], columns=columns)

    def text(self, path: str) -> LogText:
        """Return the first text of a text field; empty without one."""
        texts = self.texts.get(path)
        return texts[0] if texts else LogText("")


MessageDecoder = Decoder | ValueDecoder | SentenceDecoder


@dataclass(slots=True)
class TopicCollector:
    """Collector of the messages of one topic, to which blocks of messages are fed.

    A topic has several channels in a ROS 1 bag: one for each publisher.

    Attributes
    ----------
    channel : the first channel of the topic
    decoders : the decoder of each channel of the topic, by the id of the channel
    """

    channel: Channel
    decoders: dict[int, MessageDecoder] = field(default_factory=dict)
    _times: GrowingColumn = field(default_factory=lambda: GrowingColumn(0))
    _stretches: list[tuple[int, int]] = field(default_factory=list)
    _columns: dict[tuple[str, bool], GrowingColumn] = field(default_factory=dict)
    _texts: dict[str, dict[bytes, int]] = field(default_factory=dict)
    _unreadable: int = 0

    def feed(self, block: MessageBlock, channel_id: int) -> None:
        """Add the messages of a block whose channel has the id `channel_id`."""
        decoder, expected = self.decoders[channel_id], self.channel.count or 0
        unread = np.flatnonzero(block.channel == channel_id)
        while len(unread):
            chosen = unread[:_MESSAGES_AT_ONCE]
            decoded = decoder.decode(block.data, block.start[chosen], block.end[chosen])
            rows, unread = np.split(unread, [len(decoded.readable)])
            readable = rows[decoded.readable]
            self._unreadable += len(rows) - len(readable)
            if not len(readable):
                continue
            self._times.add(block.log_time_ns[readable], expected)
            self._stretches.append((channel_id, len(readable)))
            for path, primitive in decoder.types.items():
                values: NDArray[Any]
                if is_text := primitive == "string":
                    values = decoded.text_codes(path, self._texts.setdefault(path, {}))
                else:
                    values = decoded.numbers(path)
                column = self._columns.setdefault((path, is_text), GrowingColumn(-1 if is_text else 0))
                column.add(values, expected)

    def table(self) -> TopicTable:
        """Return the table of all messages, sorted by log time, and drop them from the collector.

        Publishers may use different versions of the message type: only the columns that all of them have are kept.
        """
        times = self._times.rows()
        # The messages of one publisher may all be recorded later than the messages of another.
        stored = [times] if len(self.decoders) == 1 else _split_by_channel(times, self._stretches, self.decoders)
        step = max(map(find_backward_step, stored), default=NO_BACKWARD_STEP)
        order = None if (times[1:] >= times[:-1]).all() else np.argsort(times, kind="stable")
        columns: dict[str, NDArray[Any]] = {}
        texts: dict[str, list[LogText]] = {}
        for path, is_text in [*self._columns]:
            values = self._columns.pop((path, is_text)).rows()
            if len(values) < len(times):
                continue
            columns[path] = values if order is None else values[order]
            if is_text:
                texts[path] = [LogText(text.decode("utf-8", "replace")) for text in self._texts[path]]
        topic, message_type = self.channel.topic, self.channel.message_type
        times = times if order is None else times[order]
        return TopicTable(topic, message_type, times, columns, texts, self._unreadable, step)


def _split_by_channel(times: Ints, stretches: list[tuple[int, int]], channels: Iterable[int]) -> list[Ints]:
    """Return the log times (n,) of each channel.

    Parameters
    ----------
    stretches : for each block of messages its channel and the number of its messages, in the order of `times`
    """
    channel_ids = np.repeat(*np.array(stretches, np.int64).reshape(-1, 2).T)
    return [times[channel_ids == channel] for channel in channels]


def find_backward_step(times: Ints) -> BackwardStep:
    """Return the largest step back of log times (n,) in the order of the file."""
    if (times[1:] >= times[:-1]).all():
        return NO_BACKWARD_STEP
    steps = np.diff(times)
    step_ns = int(-steps.min())
    stretch = np.concatenate([[0], np.cumsum(steps < -(DISORDER_NS if step_ns > DISORDER_NS else OUT_OF_ORDER_NS))])
    pieces = 1 + np.count_nonzero(np.diff(stretch[np.argsort(times, kind="stable")]))
    return BackwardStep(step_ns, float(pieces / (stretch[-1] + 1)), int(times[np.argmin(steps)]))


DYNAMIC_JOINT_STATE = "control_msgs/DynamicJointState"
"""Message type that states the values of each joint by name of an interface."""

_NAMES, _INTERFACES, _VALUES = "joint_names[*]", "interface_values[*].interface_names", "interface_values[*].values"


class JointColumns(Decoded):
    """Messages of DynamicJointState with the columns of a JointState; NaN where a joint lacks the interface."""

    def text_codes(self, path: str, known: dict[bytes, int]) -> Ints:
        """Return the code of each text of a text field, as `Decoded.text_codes`; ``name[*]`` are the joints."""
        return super().text_codes(_NAMES if path == "name[*]" else path, known)

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a field of the header (n,), or the values of the interface that a path names, of each joint (n, k)."""
        if path in self.layout.slots:
            return super().numbers(path)
        texts: dict[bytes, int] = {}
        joints = self.text_codes(_NAMES, texts).shape[1]
        interfaces = self.text_codes(f"{_INTERFACES}[*]", texts)
        values = self.numbers(f"{_VALUES}[*]")
        named, valued = (self.numbers(f"{of}[#]")[:, :joints] for of in (_INTERFACES, _VALUES))
        wanted, column = texts.get(path.removesuffix("[*]").encode(), -2), np.full((len(values), joints), np.nan)
        for _, rows_of_shape in self.by_shape():
            # In messages of one shape each joint has the same number of interfaces, in the same columns.
            rows = np.arange(len(values))[rows_of_shape]
            names, numbers = named[rows[0]], valued[rows[0]]
            both = np.minimum(names, numbers)
            joint = np.repeat(np.arange(len(both)), both)
            rank = np.arange(len(joint)) - np.repeat(np.cumsum(both) - both, both)
            name, value = ((np.cumsum(counts) - counts)[joint] + rank for counts in (names, numbers))
            is_read = (name < interfaces.shape[1]) & (value < values.shape[1])
            joint, name, value = joint[is_read], name[is_read], value[is_read]
            row, match = np.nonzero(interfaces[np.ix_(rows, name)] == wanted)
            column[rows[row], joint[match]] = values[rows[row], value[match]]
        return column


READ_ENCODINGS = ("cdr", "ros1", "protobuf", "json")
"""Serializations of messages that are read: CDR of ROS 2, ROS 1, Protobuf and JSON of Foxglove."""


def collector_for(
    channel: Channel,
    wanted: tuple[str, ...],
    before: TopicCollector | None = None,
    budget: DefinitionBudget | None = None,
) -> TopicCollector:
    """Return a collector with a decoder for a channel.

    Parameters
    ----------
    channel : the channel
    wanted : paths of the wanted fields, as for `icrtool.logs.messages.definitions.compile_layout`
    before : collector of another channel of the topic, to which the decoder is added; None: a new collector
    budget : budget of the log for definitions; None: a new budget for this channel

    Raises
    ------
    DefinitionError
        The channel's definition is missing or cannot be read, its serialization is not read, or the budget is used up.
    """
    budget = budget if budget is not None else DefinitionBudget()
    budget.take(channel)
    try:
        decoder = _decoder_for(channel, wanted)
    except DefinitionError as err:
        budget.spend(channel, err)
        raise
    if isinstance(inner := decoder.inner if isinstance(decoder, SentenceDecoder) else decoder, Decoder):
        budget.spend(channel, inner.layout.fields)
    collector = before if before is not None else TopicCollector(channel)
    collector.decoders[channel.id] = decoder
    return collector


def _decoder_for(channel: Channel, wanted: tuple[str, ...]) -> MessageDecoder:
    """Return the decoder of a channel by its message type and serialization; raise as `collector_for`."""
    if channel.encoding not in READ_ENCODINGS:
        raise DefinitionError(channel.topic, f"serialization {str(channel.encoding)!r} is not read")
    if channel.message_type == DYNAMIC_JOINT_STATE:
        return _interface_decoder(channel)
    if channel.encoding in ("protobuf", "json"):
        return value_decoder(channel, wanted)
    if channel.message_type == NMEA_SENTENCE:
        return SentenceDecoder(ros_decoder(channel, (*HEADER, "sentence")))
    return ros_decoder(channel, wanted)


def _interface_decoder(channel: Channel) -> Decoder:
    """Return a decoder of DynamicJointState, which reads names and values of the interfaces of all joints in a row."""
    if channel.encoding not in ("cdr", "ros1"):
        raise DefinitionError(channel.topic, f"its lists within lists are not read in {str(channel.encoding)!r}")
    in_a_row = (f"{of}[{each}]" for of in (_INTERFACES, _VALUES) for each in "*#")
    decoder = ros_decoder(channel, (*HEADER, _NAMES, *in_a_row))
    types = decoder.types
    if f"{_VALUES}[*]" not in types or any(types.get(path) != "string" for path in (_NAMES, f"{_INTERFACES}[*]")):
        raise DefinitionError(channel.message_type, "its definition in the log lacks names or values of the joints")
    header_types = {path: primitive for path, primitive in types.items() if path in HEADER}
    joint_types = {"name[*]": "string", "position[*]": "float64", "velocity[*]": "float64"}
    return Decoder(decoder.layout, header_types | joint_types, JointColumns)
