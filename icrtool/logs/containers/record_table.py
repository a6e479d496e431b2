"""Where chunks are in a file, and records in a chunk: by the file's own index, else one after the other.

The index of messages is only a hint. Each record begins where the one before it ends, which is checked for all of them
at once; records that it lacks are found by following their lengths, and so are all records where it is wrong.
"""

from __future__ import annotations

from collections.abc import Callable
from struct import Struct
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bytes, Ints
from icrtool.logs.containers.decompress import STORED
from icrtool.logs.containers.source import Held

MCAP_SCHEMA, MCAP_CHANNEL, MCAP_MESSAGE = 3, 4, 5
BAG_MESSAGE, BAG_CONNECTION = 2, 7
"""Operation codes of records."""

MOST_ROWS = 1 << 18
"""Records that are followed at a time."""

_MOST_GAPS = 1 << 8
"""Between messages of an index, that are followed; where there are more, all records are."""

_MOST_HEADERS = 1 << 4
"""Kinds of bag headers that all records are compared with; further ones are read one by one."""

_BAG_VALUES = {b"op=": 1, b"conn=": 4, b"time=": 8}
"""Bytes of the values in a bag's headers."""

_MCAP_HEAD, _LENGTH = Struct("<BQ"), Struct("<I")
_MCAP_HEADS = np.dtype(
    [("code", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("time", "<i8"), ("published", "<u8")]
)
_LEAST_MESSAGE_BYTES = _MCAP_HEADS.itemsize - _MCAP_HEAD.size


class Chunk(NamedTuple):
    """A chunk in a file, by the index.

    Attributes
    ----------
    at, length : where its content is in the file; before a bag's record is read: where that begins, and 0
    channels : those it holds, None without an entry
    begin_ns, end_ns : first and last log time in it, 0 where they are not known
    index_length : of the message index records that follow it, and of what of a bag's record was not read
    size : of its records, decompressed; -1 where there is no chunk in its place
    compression : as the log calls it
    """

    at: int
    length: int = 0
    channels: frozenset[int] | None = None
    begin_ns: int = 0
    end_ns: int = 0
    index_length: int = 0
    size: int = 0
    compression: str = ""

    def is_partly(self, wanted: frozenset[int]) -> bool:
        """Return whether it holds other channels, too."""
        return self.channels is not None and not self.channels <= wanted

    @property
    def is_stored(self) -> bool:
        """Whether its records can be read one by one."""
        return self.compression in STORED and self.index_length > 0 and self.size <= self.length


class Part(NamedTuple):
    """What is read of a chunk.

    Attributes
    ----------
    messages : where messages begin in the records that are read, by the message index; None without one
    ranges : begin and end (2, n) of the wanted records, where only those are read
    held : its bytes, read ahead of a distant file
    records : the wanted ones, likewise
    """

    chunk: Chunk
    messages: Ints | None = None
    ranges: Ints | None = None
    held: Held | None = None
    records: bytes | None = None

    @property
    def wanted_bytes(self) -> int:
        """Bytes of the records that are read."""
        return max(self.chunk.size, 0) if self.ranges is None else int((self.ranges[1] - self.ranges[0]).sum())


class Records(NamedTuple):
    """Records that follow one another.

    Attributes
    ----------
    messages : (4, n) channel, log time [ns], begin and end of the content
    others : operation code, begin, and begin and end of the content of the other ones
    stop : the first byte behind: an incomplete record, another kind of record, or the end
    """

    messages: Ints
    others: list[tuple[int, int, int, int]]
    stop: int


def scan_mcap(data: Bytes, begin: int, hint: Ints | None = None) -> Records:
    """Find the schema, channel and message records from `begin` on.

    Parameters
    ----------
    hint : (n,) where messages are by the index, ascending; None without one
    """
    starts, stop = _starts(data, begin, hint, _follow_mcap, _mcap_ends)
    codes = data[starts]
    is_message = codes == MCAP_MESSAGE
    at = starts if is_message.all() else starts[is_message]
    heads = _mcap_heads(data, at)
    messages = np.empty((4, len(at)), np.int64)
    messages[0], messages[1] = heads["channel"], heads["time"]
    messages[2], messages[3] = at + _MCAP_HEADS.itemsize, at + (9 + heads["length"].astype(np.int64))
    others = []
    for place in starts[~is_message].tolist():
        code, length = _MCAP_HEAD.unpack_from(data.data, place)
        others.append((code, place, place + 9, place + 9 + length))
    return Records(messages, others, stop)


def scan_bag(data: Bytes, begin: int, hint: Ints | None = None) -> Records:
    """Find the message and connection records of a ROS 1 bag from `begin` on; as `scan_mcap`."""
    starts, stop = _starts(data, begin, hint, _follow_bag, _bag_ends)
    sizes = _unaligned(data, "<u4")[starts] + np.int64(8)
    table = np.empty((5, len(starts)), np.int64)
    left, rounds = np.arange(len(starts)), 0
    while len(left):
        # Most have headers of the same fields.
        size = int(sizes[left[0]])
        fits = sizes[left] == size if rounds < _MOST_HEADERS else np.arange(len(left)) == 0
        heads = _unaligned(data, f"V{size}")[starts[left if fits.all() else left[fits]]]
        fields = _fields(heads[0].tobytes()[:-4])
        same, end = np.ones(len(heads), np.bool_), 0
        for at, length in [*sorted(fields.values()), (size - 4, 0)]:
            if at > end:
                parts = _strided(heads, end, f"V{at - end}")
                same &= parts == parts[0]
            end = at + length
        if not same.all():
            fits[fits] = same
            heads = heads[same]
        rows = slice(None) if len(heads) == len(starts) else left[fits]
        table[0, rows] = _strided(heads, fields[b"op="][0], "u1") if b"op=" in fields else 0
        table[1, rows] = _strided(heads, fields[b"conn="][0], "<u4") if b"conn=" in fields else -1
        table[2, rows] = 0
        if b"time=" in fields:
            seconds, nanoseconds = (_strided(heads, fields[b"time="][0] + part, "<u4") for part in (0, 4))
            table[2, rows] = seconds * np.int64(1_000_000_000) + nanoseconds
        table[3, rows] = starts[rows] + size
        table[4, rows] = table[3, rows] + _strided(heads, size - 4, "<u4")
        left, rounds = left[~fits], rounds + 1
    codes, messages = table[0], table[1:]
    is_message = codes == BAG_MESSAGE
    others = [
        (BAG_CONNECTION, int(starts[row]), *messages[2:, row].tolist())
        for row in np.flatnonzero(codes == BAG_CONNECTION)
    ]
    return Records(messages if is_message.all() else messages[:, is_message], others, stop)


def _starts(
    data: Bytes,
    begin: int,
    hint: Ints | None,
    follow: Callable[[memoryview, int, int], tuple[list[int], int]],
    ends: Callable[[Bytes, Ints], Ints],
) -> tuple[Ints, int]:
    """Return where records begin (n,), and the first byte behind them."""
    view = data.data
    if hint is not None and 0 < len(hint) <= MOST_ROWS and hint[0] >= begin:
        first, last = np.append(begin, ends(data, hint)), np.append(hint, len(data))
        gaps = np.flatnonzero(first != last)
        if (first <= last).all() and (last[:-1] < first[1:]).all() and len(gaps) <= _MOST_GAPS:
            found = [follow(view, *gap) for gap in zip(first[gaps].tolist(), last[gaps].tolist(), strict=True)]
            if all(stop == last[gap] for gap, (_, stop) in zip(gaps, found, strict=True)):
                others = np.array([at for some, _ in found for at in some], np.int64)
                return (np.sort(np.append(hint, others)) if len(others) else hint), len(data)
    starts, stop = follow(view, begin, len(data))
    return np.array(starts, np.int64), stop


def _follow_mcap(data: memoryview, begin: int, end: int) -> tuple[list[int], int]:
    """Return where the records [begin, end) begin, one after the other, and where they stop."""
    starts: list[int] = []
    at, unpack = begin, _MCAP_HEAD.unpack_from
    while at + 9 <= end and len(starts) < MOST_ROWS:
        code, length = unpack(data, at)
        behind = at + 9 + length
        if behind > end or not MCAP_SCHEMA <= code <= MCAP_MESSAGE:
            break
        if code == MCAP_MESSAGE and length < _LEAST_MESSAGE_BYTES:
            break
        starts.append(at)
        at = behind
    return starts, at


def _mcap_ends(data: Bytes, at: Ints) -> Ints:
    """Return where messages (n,) end; their begin where there is none."""
    if at[-1] > len(data) - _MCAP_HEADS.itemsize:
        return at
    heads = _mcap_heads(data, at)
    length = heads["length"]
    good = (heads["code"] == MCAP_MESSAGE) & (length >= _LEAST_MESSAGE_BYTES) & (length <= len(data))
    return np.where(good, at + (length.astype(np.int64) + 9), at)


def _mcap_heads(data: Bytes, at: Ints) -> NDArray[Any]:
    """Return the heads (n,) of messages."""
    together: NDArray[Any] = _unaligned(data, f"V{_MCAP_HEADS.itemsize}")[at].view(_MCAP_HEADS)
    return together


def _follow_bag(data: memoryview, begin: int, end: int) -> tuple[list[int], int]:
    """Return where the records [begin, end) of a bag begin, one after the other, and where they stop."""
    starts: list[int] = []
    at, unpack = begin, _LENGTH.unpack_from
    while at + 8 <= end and len(starts) < MOST_ROWS:
        content = at + 8 + unpack(data, at)[0]
        if content > end:
            break
        behind = content + unpack(data, content - 4)[0]
        if behind > end:
            break
        starts.append(at)
        at = behind
    return starts, at


def _bag_ends(data: Bytes, at: Ints) -> Ints:
    """Return where records (n,) of a bag end that have headers as long as the first; the begin of others."""
    lengths, last = _unaligned(data, "<u4"), len(data) - 4
    size = 8 + int(lengths[at[0]]) if at[-1] <= last else len(data)
    if at[-1] + size > len(data):
        return at
    return np.where(lengths[at] == size - 8, at + (size + lengths[at + (size - 4)].astype(np.int64)), at)


def _fields(header: bytes) -> dict[bytes, tuple[int, int]]:
    """Return offset and length of the values in a header, the four bytes of its length included, by name."""
    fields: dict[bytes, tuple[int, int]] = {}
    at = 4
    while at + 4 <= len(header):
        begin = at + 4
        at = begin + _LENGTH.unpack_from(header, at)[0]
        if at > len(header):
            break
        for name, length in _BAG_VALUES.items():
            if at - begin == len(name) + length and header.startswith(name, begin):
                fields[name] = at - length, length
    return fields


def _strided(rows: NDArray[Any], offset: int, kind: str) -> NDArray[Any]:
    """Return the value at an offset in each of some rows of bytes (n,)."""
    return np.ndarray(len(rows), kind, rows, offset, rows.strides)


def _unaligned(data: Bytes, kind: str) -> NDArray[Any]:
    """Return the value that begins at each byte."""
    return np.ndarray(max(len(data) - np.dtype(kind).itemsize + 1, 0), kind, data, strides=(1,))
