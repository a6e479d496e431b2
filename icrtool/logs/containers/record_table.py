"""Compiled scans over the records of a decompressed chunk: where each message is, without one Python object each."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bytes
from icrtool.kernels.compiled import njit
from icrtool.logs.containers.chunked_file import BAG_CONNECTION, BAG_MESSAGE, MCAP_MESSAGE, MCAP_SCHEMA


@njit
def little_endian(data: Bytes, at: int, size: int) -> int:
    """Return the unsigned little-endian integer of `size` bytes; a value above 2^63 comes out negative."""
    value = np.uint64(0)
    for i in range(size):
        value |= np.uint64(data[at + i]) << np.uint64(8 * i)
    return int(np.int64(value))


@njit
def scan_mcap(data: Bytes, begin: int, rows: NDArray[np.int64]) -> tuple[int, int]:
    """Find schema, channel and message records.

    Parameters
    ----------
    data : chunk or piece of a file; scanning starts at `begin`
    rows : int64 (capacity, 5), filled with opcode, channel id, log time [ns], start, end of content

    Returns
    -------
    count, stop : rows filled; the position of the first byte not consumed (an incomplete record, another kind of
        record, or the end). Where `rows` is full the scan stops too.
    """
    at, count, size = begin, 0, len(data)
    while at + 9 <= size and count < len(rows):
        opcode = data[at]
        length = little_endian(data, at + 1, 8)
        content = at + 9
        if length < 0 or length > size - content or opcode < MCAP_SCHEMA or opcode > MCAP_MESSAGE:
            break
        rows[count, 0] = opcode
        rows[count, 3] = content
        rows[count, 4] = content + length
        if opcode == MCAP_MESSAGE:
            if length < 22:
                break
            rows[count, 1] = little_endian(data, content, 2)
            rows[count, 2] = little_endian(data, content + 6, 8)
            rows[count, 3] = content + 22
        count += 1
        at = content + length
    return count, at


@njit
def scan_bag(data: Bytes, begin: int, rows: NDArray[np.int64]) -> tuple[int, int]:
    """Find message and connection records of a ROS 1 bag chunk.

    Parameters and returns as `scan_mcap`; for a connection the range is that of its data (the header its publisher
    sent), and its log time is replaced by the position of the record's own header.
    """
    at, count, size = begin, 0, len(data)
    while at + 4 <= size and count < len(rows):
        header_length = little_endian(data, at, 4)
        header = at + 4
        if header_length > size - header - 4:
            break
        opcode, connection, stamp = 0, -1, 0
        field = header
        while field + 4 <= header + header_length:
            length = little_endian(data, field, 4)
            name = field + 4
            field = name + length
            if field > header + header_length:
                break
            if length == 4 and data[name] == 111 and data[name + 1] == 112 and data[name + 2] == 61:  # op=
                opcode = data[name + 3]
            elif length == 9 and data[name] == 99 and data[name + 4] == 61:  # conn=
                connection = little_endian(data, name + 5, 4)
            elif length == 13 and data[name] == 116 and data[name + 4] == 61:  # time=
                stamp = little_endian(data, name + 5, 4) * 1_000_000_000 + little_endian(data, name + 9, 4)
        content = header + header_length + 4
        length = little_endian(data, content - 4, 4)
        if length > size - content:
            break
        if opcode in (BAG_MESSAGE, BAG_CONNECTION):
            rows[count, 0] = opcode
            rows[count, 1] = connection
            rows[count, 2] = stamp if opcode == BAG_MESSAGE else header
            rows[count, 3] = content
            rows[count, 4] = content + length
            count += 1
        at = content + length
    return count, at
