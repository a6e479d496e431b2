"""The messages of a topic as one table of columns, gathered block by block, and the decoder of each of its channels.

The decoder is chosen by message type and by how messages are serialized.
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
"""Largest number of values for which a column gets memory in advance, by the count that the log states."""

_MESSAGES_AT_ONCE = 1 << 14
"""Messages that are decoded together."""

LARGEST_VALUE = 1e30
"""Largest value that is kept, in any unit; a larger number becomes infinite, so that no power of a finite number
overflows."""


class GrowingColumn:
    """A column that grows in place, without copies of all rows; it holds a single row while all rows are equal.

    Parameters
    ----------
    lacking : value of integers where a row has fewer elements than others; floats are NaN there
    """

    def __init__(self, lacking: int) -> None:
        self._lacking = lacking
        self._rows = 0
        self._values: NDArray[Any] = np.empty(0, np.int64)

    def add(self, part: NDArray[Any], expected: int) -> None:
        """Add a copy of rows (m,) or (m, k), of `expected` rows in all, as the log states."""
        before, held = self._rows, self._values
        self._rows += len(part)
        one = _single_row(part) if len(held) <= 1 else None
        if before == 0 and one is not None:
            self._values = one
        elif one is None or len(held) > 1 or one.shape != held.shape or one.tobytes() != held.tobytes():
            width = max(part.shape[1:], held.shape[1:])
            kind = np.result_type(part, held) if before else part.dtype
            added = [(before, part)]
            if before == 0 or len(held) < self._rows or width > held.shape[1:] or kind != held.dtype:
                likely = min(expected, _MOST_EXPECTED // max(*width, 1, 1))
                self._values = np.empty((*width, max(2 * before, self._rows, likely)), kind).T
                if before:
                    old = held[:before] if len(held) > 1 else np.broadcast_to(held, (before, *held.shape[1:]))
                    added.insert(0, (0, old))
            for begin, some in added:
                rows = self._values[begin : begin + len(some)]
                if some.ndim == 2 and some.shape[1] < rows.shape[1]:
                    rows[:, some.shape[1] :] = np.nan if rows.dtype.kind == "f" else self._lacking
                    rows = rows[:, : some.shape[1]]
                _copy(some, rows)

    def taken(self) -> NDArray[Any]:
        """Return the rows (n,) or (n, k); they cannot be written to where all are the same."""
        values = self._values
        return values[: self._rows] if len(values) > 1 else np.broadcast_to(values, (self._rows, *values.shape[1:]))


def _single_row(rows: NDArray[Any]) -> NDArray[Any] | None:
    """Return the row (1,) or (1, k) that all rows equal bit by bit; None where they differ, or there is none."""
    bits = rows.view(np.int64)
    if len(rows) == 0 or (rows.strides[0] and ((bits[-1] != bits[0]).any() or (bits != bits[0]).any())):
        return None
    row = np.empty_like(rows[:1])
    _copy(rows[:1], row)
    return row


def _copy(source: NDArray[Any], target: NDArray[Any]) -> None:
    """Copy numbers, which any arithmetic may then use: a signalling NaN becomes a NaN, a too large number infinite."""
    if target.dtype.kind != "f":
        target[...] = source
        return
    target[...] = source  # copied first: source and target may differ in the order of their memory
    with np.errstate(invalid="ignore"):
        np.multiply(target, 1.0, out=target)
    if target.size and not (target.min() >= -LARGEST_VALUE and target.max() <= LARGEST_VALUE):  # NaN compares false
        np.copyto(target, np.copysign(np.inf, target), where=np.abs(target) > LARGEST_VALUE)


class SetBack(NamedTuple):
    """The largest step of log time back from one stored message to the next, and how sorting mixes the messages.

    Attributes
    ----------
    step_ns : the largest step back
    pieces : mean number of pieces into which sorting cuts a stretch between such steps: 1 where stretches only change
        places, about 2 where single messages are out of place, many where times repeat
    before_ns : log time of the last message before the largest step
    """

    step_ns: int
    pieces: float
    before_ns: int = 0


NOT_SET_BACK = SetBack(0, 0.0)

FRAME_FIELD = "header.frame_id"
STAMPS = (("header.stamp.sec", "header.stamp.nanosec"), ("stamp.sec", "stamp.nanosec"))
"""Fields of a message's stamp: in its header, or where it has no header, next to its values."""

HEADER = (*STAMPS[0], FRAME_FIELD, *STAMPS[1])
"""Fields of a message's header, which are read of every topic."""

DISORDER_NS = 2_000_000_000
"""Limit of the disorder of stored messages [ns]; a header stamp further from log time is from another clock."""

OUT_OF_ORDER_NS = 200_000_000
"""Usual limit of the disorder of messages of one topic [ns]."""


@dataclass(frozen=True, slots=True)
class TopicTable:
    """All messages of one topic, in log-time order.

    Attributes
    ----------
    log_time_ns : int64 (n,)
    columns : by field path; float64 or int64, (n,) or, for an array field, (n, k), NaN or 0 where a message has fewer
        elements. A text field holds indices into `texts`.
    texts : the distinct texts of each text field
    unreadable : number of messages that did not have the shape of their type
    set_back : steps back of the clock that the messages were logged with
    """

    topic: LogText
    message_type: LogText
    log_time_ns: Ints
    columns: dict[str, NDArray[Any]]
    texts: dict[str, list[LogText]]
    unreadable: int
    set_back: SetBack = NOT_SET_BACK

    def __len__(self) -> int:
        return len(self.log_time_ns)

    def find(self, *paths: str) -> NDArray[Any] | None:
        """Return the first of these columns of numbers that the type has: drivers spell ``hAcc`` or ``h_acc``."""
        return next((self.columns[path] for path in paths if path in self.columns and path not in self.texts), None)

    def integers(self, *paths: str) -> Ints | None:
        """Return what `find` does; None where the log's own definition has no whole numbers there."""
        values = self.find(*paths)
        return values if values is not None and values.dtype.kind == "i" else None

    def column(self, *paths: str) -> NDArray[Any]:
        """Return the first of these columns of numbers that the type has.

        Raises
        ------
        DefinitionError
            The type, as the log defines it, has none of them.
        """
        values = self.find(*paths)
        if values is None:
            raise DefinitionError(self.topic, f"its {self.message_type} has no numbers {' or '.join(paths)}")
        return values

    def words(self, path: str) -> tuple[Ints, list[LogText]]:
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
        """Return the first of these columns as float64, not to be written to; NaN everywhere when the type has none."""
        values = self.find(*paths)
        return np.full(len(self), np.nan) if values is None else values.astype(np.float64, copy=False)

    def rows(self, chosen: NDArray[np.bool_] | Ints) -> TopicTable:
        """Return the table of the chosen messages (n,), or of the messages in some rows (m,)."""
        columns = {path: values[chosen] for path, values in self.columns.items()}
        return replace(self, log_time_ns=self.log_time_ns[chosen], columns=columns)

    def text(self, path: str) -> LogText:
        """Return the first text of a text field, empty when there is none."""
        texts = self.texts.get(path)
        return texts[0] if texts else LogText("")


MessageDecoder = Decoder | ValueDecoder | SentenceDecoder


@dataclass(slots=True)
class TopicCollector:
    """Gathers the columns of one topic while blocks go by: a ROS 1 bag gives each publisher a channel of its own.

    Attributes
    ----------
    channel : the first channel; decoders : the decoder of each channel, by its number
    """

    channel: Channel
    decoders: dict[int, MessageDecoder] = field(default_factory=dict)
    _times: GrowingColumn = field(default_factory=lambda: GrowingColumn(0))
    _numbers: list[tuple[int, int]] = field(default_factory=list)
    _columns: dict[tuple[str, bool], GrowingColumn] = field(default_factory=dict)
    _texts: dict[str, dict[bytes, int]] = field(default_factory=dict)
    _unreadable: int = 0

    def feed(self, block: MessageBlock, number: int) -> None:
        """Add the messages of a block whose channel is `number`."""
        decoder, expected = self.decoders[number], self.channel.count or 0
        unread = np.flatnonzero(block.channel == number)
        while len(unread):
            some = unread[:_MESSAGES_AT_ONCE]
            decoded = decoder.decode(block.data, block.start[some], block.end[some])
            rows, unread = np.split(unread, [len(decoded.readable)])
            readable = rows[decoded.readable]
            self._unreadable += len(rows) - len(readable)
            if not len(readable):
                continue
            self._times.add(block.log_time_ns[readable], expected)
            self._numbers.append((number, len(readable)))
            for path, kind in decoder.kinds.items():
                values: NDArray[Any]
                if is_text := kind == "string":
                    values = decoded.text_numbers(path, self._texts.setdefault(path, {}))
                else:
                    values = decoded.numbers(path)
                column = self._columns.setdefault((path, is_text), GrowingColumn(-1 if is_text else 0))
                column.add(values, expected)

    def table(self) -> TopicTable:
        """Return what was gathered, sorted by log time, and forget it.

        Publishers may have been built from different versions of the type: columns that all publishers have are kept.
        """
        times = self._times.taken()
        # each publisher by itself: one may be recorded later than another
        stored = [times] if len(self.decoders) == 1 else _of_each(times, self._numbers, self.decoders)
        back = max(map(set_back_of, stored), default=NOT_SET_BACK)
        order = None if (times[1:] >= times[:-1]).all() else np.argsort(times, kind="stable")
        columns: dict[str, NDArray[Any]] = {}
        texts: dict[str, list[LogText]] = {}
        for path, is_text in [*self._columns]:
            values = self._columns.pop((path, is_text)).taken()
            if len(values) < len(times):
                continue
            columns[path] = values if order is None else values[order]
            if is_text:
                texts[path] = [LogText(text.decode("utf-8", "replace")) for text in self._texts[path]]
        topic, message_type = self.channel.topic, self.channel.message_type
        times = times if order is None else times[order]
        return TopicTable(topic, message_type, times, columns, texts, self._unreadable, back)


def _of_each(times: Ints, stretches: list[tuple[int, int]], channels: Iterable[int]) -> list[Ints]:
    """Return the log times (n,) of each channel; `stretches`: channel and number of messages that follow each other."""
    numbers = np.repeat(*np.array(stretches, np.int64).reshape(-1, 2).T)
    return [times[numbers == channel] for channel in channels]


def set_back_of(times: Ints) -> SetBack:
    """Return how stored log times (n,) go back, and what sorting does to the stretches between."""
    if (times[1:] >= times[:-1]).all():
        return NOT_SET_BACK
    steps = np.diff(times)
    step_ns = int(-steps.min())
    stretch = np.concatenate([[0], np.cumsum(steps < -(DISORDER_NS if step_ns > DISORDER_NS else OUT_OF_ORDER_NS))])
    pieces = 1 + np.count_nonzero(np.diff(stretch[np.argsort(times, kind="stable")]))
    return SetBack(step_ns, float(pieces / (stretch[-1] + 1)), int(times[np.argmin(steps)]))


DYNAMIC_JOINT_STATE = "control_msgs/DynamicJointState"
_NAMES, _INTERFACES, _VALUES = "joint_names[*]", "interface_values[*].interface_names", "interface_values[*].values"


class JointColumns(Decoded):
    """Some messages of DynamicJointState with the columns of a JointState; NaN where a joint has no such interface."""

    def text_numbers(self, path: str, known: dict[bytes, int]) -> Ints:
        """Return the numbers of a text field's texts; new texts become known."""
        return super().text_numbers(_NAMES if path == "name[*]" else path, known)

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a field of the header, or the interface of each joint that the path names (n, longest)."""
        if path in self.layout.slots:
            return super().numbers(path)
        texts: dict[bytes, int] = {}
        joints = self.text_numbers(_NAMES, texts).shape[1]
        interfaces = self.text_numbers(f"{_INTERFACES}[*]", texts)
        values = self.numbers(f"{_VALUES}[*]")
        named, valued = (self.numbers(f"{of}[#]")[:, :joints] for of in (_INTERFACES, _VALUES))
        wanted, column = texts.get(path.removesuffix("[*]").encode(), -2), np.full((len(values), joints), np.nan)
        for _, some in self.by_shape():
            # messages of one shape have the same number of interfaces of each joint: their places in a row are the same
            rows = np.arange(len(values))[some]
            names, numbers = named[rows[0]], valued[rows[0]]
            both = np.minimum(names, numbers)
            joint = np.repeat(np.arange(len(both)), both)
            place = np.arange(len(joint)) - np.repeat(np.cumsum(both) - both, both)
            name, value = ((np.cumsum(counts) - counts)[joint] + place for counts in (names, numbers))
            taken = (name < interfaces.shape[1]) & (value < values.shape[1])
            joint, name, value = joint[taken], name[taken], value[taken]
            row, place = np.nonzero(interfaces[np.ix_(rows, name)] == wanted)
            column[rows[row], joint[place]] = values[rows[row], value[place]]
        return column


READ_ENCODINGS = ("cdr", "ros1", "protobuf", "json")
"""Serializations of messages that are read: of ROS 2, of ROS 1, and of Foxglove."""


def collector_for(
    channel: Channel,
    wanted: tuple[str, ...],
    before: TopicCollector | None = None,
    budget: DefinitionBudget | None = None,
) -> TopicCollector:
    """Return the collector of a channel's wanted columns: `before` where another channel of the topic has one.

    Parameters
    ----------
    budget : budget of the log; None: a budget for this channel alone

    Raises
    ------
    DefinitionError
        The layout of the channel's type is not known, or its serialization is not read; or the budget is spent.
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
    """Return the decoder of DynamicJointState: it takes names and values of all interfaces of the joints in a row."""
    if channel.encoding not in ("cdr", "ros1"):
        raise DefinitionError(channel.topic, f"its lists within lists are not read in {str(channel.encoding)!r}")
    in_a_row = (f"{of}[{each}]" for of in (_INTERFACES, _VALUES) for each in "*#")
    decoder = ros_decoder(channel, (*HEADER, _NAMES, *in_a_row))
    kinds = decoder.kinds
    if f"{_VALUES}[*]" not in kinds or any(kinds.get(path) != "string" for path in (_NAMES, f"{_INTERFACES}[*]")):
        raise DefinitionError(channel.message_type, "its definition in the log lacks names or values of the joints")
    of_header = {path: kind for path, kind in kinds.items() if path in HEADER}
    of_joints = {"name[*]": "string", "position[*]": "float64", "velocity[*]": "float64"}
    return Decoder(decoder.layout, of_header | of_joints, JointColumns)
