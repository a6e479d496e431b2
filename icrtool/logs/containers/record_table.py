"""Compiled scans over the records of a decompressed chunk: where each message is, without one Python object each."""

from __future__ import annotations

from typing import cast

import numpy as np

from icrtool.kernels.arrays import Bools, Bytes, Ints
from icrtool.kernels.compiled import njit
from icrtool.kernels.words import read_word
from icrtool.logs.containers.chunked_file import (
    BAG_CONNECTION,
    BAG_MESSAGE,
    MCAP_MESSAGE,
    MCAP_MESSAGE_INDEX,
    MCAP_SCHEMA,
)
from icrtool.logs.containers.decompress import LARGEST_CHUNK_BYTES

_ZERO, _TWO, _FOUR, _EIGHT = (cast(int, np.int64(value)) for value in (0, 2, 4, 8))
"""Typed: numba compiles another copy of a function for every plain number that it is called with."""


@njit
def little_endian(data: Bytes, at: int, size: int) -> int:
    """Return the unsigned little-endian integer of `size` bytes; a value above 2^63 comes out negative."""
    return int(np.int64(read_word(data, at, size, _ZERO)))


@njit
def scan_mcap(data: Bytes, begin: int, messages: Ints, others: Ints, filled: int) -> tuple[int, int, int]:
    """Find schema, channel and message records.

    Parameters
    ----------
    data : chunk or piece of a file; scanning starts at `begin`
    messages : (4, capacity), filled with channel id, log time [ns], start and end of content, from column `filled` on
    others : (4, capacity), filled for other records with opcode, an unused number, start and end of content; where it
        has no columns they are passed over

    Returns
    -------
    messages, others : columns filled
    stop : the first byte not consumed: an incomplete record, another kind of record, or the end; or one of the tables
        is full
    """
    at, count, other, size = begin, filled, 0, len(data)
    while at + 9 <= size and count < messages.shape[1]:
        opcode, length, content = data[at], little_endian(data, at + 1, _EIGHT), at + 9
        if length < 0 or length > size - content or opcode < MCAP_SCHEMA or opcode > MCAP_MESSAGE:
            break
        if opcode == MCAP_MESSAGE:
            if length < 22:
                break
            messages[0, count] = little_endian(data, content, _TWO)
            messages[1, count] = little_endian(data, content + 6, _EIGHT)
            messages[2, count], messages[3, count] = content + 22, content + length
            count += 1
        elif others.shape[1]:
            if other == others.shape[1]:
                break
            others[0, other], others[2, other], others[3, other] = opcode, content, content + length
            other += 1
        at = content + length
    return count, other, at


@njit
def scan_bag(data: Bytes, begin: int, messages: Ints, others: Ints, filled: int) -> tuple[int, int, int]:
    """Find message and connection records of a ROS 1 bag chunk.

    Parameters and returns as `scan_mcap`; for a connection the range is that of its data (the header its publisher
    sent), its number is the connection, and in place of the opcode is the position of the record's own header.
    """
    at, count, other, size = begin, filled, 0, len(data)
    while at + 4 <= size and count < messages.shape[1]:
        header_length = little_endian(data, at, _FOUR)
        header = at + 4
        if header_length > size - header - 4:
            break
        opcode, connection, stamp = 0, -1, 0
        field = header
        while field + 4 <= header + header_length:
            length = little_endian(data, field, _FOUR)
            name = field + 4
            field = name + length
            if field > header + header_length:
                break
            if length == 4 and data[name] == 111 and data[name + 1] == 112 and data[name + 2] == 61:  # op=
                opcode = data[name + 3]
            elif length == 9 and data[name] == 99 and data[name + 4] == 61:  # conn=
                connection = little_endian(data, name + 5, _FOUR)
            elif length == 13 and data[name] == 116 and data[name + 4] == 61:  # time=
                seconds, nanoseconds = little_endian(data, name + 5, _FOUR), little_endian(data, name + 9, _FOUR)
                stamp = seconds * 1_000_000_000 + nanoseconds
        content = header + header_length + 4
        length = little_endian(data, content - 4, _FOUR)
        if length > size - content:
            break
        if opcode == BAG_MESSAGE:
            messages[0, count], messages[1, count] = connection, stamp
            messages[2, count], messages[3, count] = content, content + length
            count += 1
        elif opcode == BAG_CONNECTION and others.shape[1]:
            if other == others.shape[1]:
                break
            others[0, other], others[1, other] = header, connection
            others[2, other], others[3, other] = content, content + length
            other += 1
        at = content + length
    return count, other, at


@njit
def read_message_index(index: Bytes, wanted: Bools, places: Ints) -> tuple[int, int]:
    """Read the message index records behind a chunk.

    Parameters
    ----------
    wanted : (65536,) whether a channel is wanted
    places : filled with twice the place of each message in the chunk's records, and one more where it is not wanted

    Returns
    -------
    Number of messages and number of wanted ones; no messages where a record is damaged, or is of another kind.
    """
    at, count, wanted_count, size = 0, 0, 0, len(index)
    while at + 15 <= size:
        length = little_endian(index, at + 1, _EIGHT)
        if index[at] != MCAP_MESSAGE_INDEX or length < 6 or length > size - at - 9:
            return 0, 0
        is_wanted = wanted[little_endian(index, at + 9, _TWO)]
        for entry in range((length - 6) // 16):
            place = little_endian(index, at + 15 + 16 * entry + 8, _EIGHT)
            if place < 0 or place >= LARGEST_CHUNK_BYTES or count == len(places):
                return 0, 0
            places[count] = 2 * place + (not is_wanted)
            count += 1
            wanted_count += is_wanted
        at += 9 + length
    return count, wanted_count


@njit
def wanted_ranges(places: Ints, size: int, ranges: Ints) -> tuple[int, int]:
    """Find the ranges of a chunk's records that hold wanted messages.

    Parameters
    ----------
    places : of `read_message_index`, in order
    size : of the records
    ranges : (2, capacity) filled with begin and end of each range

    Returns
    -------
    Number of ranges and of bytes in them; no ranges where two messages are at the same place, or one is outside.
    """
    count, held = 0, 0
    for k in range(len(places)):
        begin = places[k] // 2
        end = places[k + 1] // 2 if k + 1 < len(places) else size
        if end <= begin:
            return 0, 0
        if places[k] % 2 == 0:
            if count and ranges[1, count - 1] == begin:
                ranges[1, count - 1] = end
            else:
                ranges[0, count], ranges[1, count] = begin, end
                count += 1
            held += end - begin
    return count, held


@njit
def copy_ranges(source: Bytes, first: int, ranges: Ints, target: Bytes) -> None:
    """Copy ranges to the target, one behind the other; `first` is the place of the source's begin."""
    at = np.uint64(0)
    for k in range(ranges.shape[1]):
        begin, size = np.uint64(ranges[0, k] - first), np.uint64(ranges[1, k] - ranges[0, k])
        for i in range(size):  # an assignment of slices takes seconds to compile
            target[at + np.uint64(i)] = source[begin + np.uint64(i)]
        at += size
