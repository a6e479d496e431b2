"""Messages that are decoded one by one, JSON, Protobuf and NMEA sentences: the wanted values of each, as columns."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from typing import Any, Protocol

import numpy as np
import orjson
from numpy.typing import NDArray

from icrtool.kernels.arrays import Bools, Ints
from icrtool.logs.containers.container import Block
from icrtool.logs.messages.decoder import MESSAGES_AT_ONCE, Decoder, text_numbers
from icrtool.logs.messages.schema import MOST_ELEMENTS, Slot, Step, steps_of
from icrtool.records.text import LONGEST_TEXT

LONGEST_MESSAGE_BYTES = 1 << 20
"""Of a message that is decoded by itself; those that icrtool uses have some hundred bytes."""

_LARGEST_INTEGER = 1 << 62
_FLOATS = ("float32", "float64")


class MessageColumns(Protocol):
    """Some decoded messages of one topic."""

    @property
    def readable(self) -> Bools:
        """Which of the messages given (m,) are readable; what follows holds those alone."""
        ...

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a field of numbers as float64 or int64: (n,) or, of a sequence, (n, longest)."""
        ...

    def text_numbers(self, path: str, known: dict[bytes, int]) -> Ints:
        """Return the numbers of a text field's texts (n,) or (n, longest), -1 for none; new texts become known."""
        ...


class MessageDecoder(Protocol):
    """Decodes the messages of one topic."""

    @property
    def slots(self) -> Mapping[str, Slot]:
        """The wanted fields that the messages have, by path."""
        ...

    def decode(self, block: Block, number: int) -> Iterator[tuple[Ints, MessageColumns]]:
        """Yield the rows (m,) of a block whose channel is `number`, some at a time, with what those messages hold."""
        ...


@dataclass(frozen=True, slots=True)
class DecodedValues:
    """Values of messages.

    Attributes
    ----------
    values : by column one of each readable message (n,): a number, a text, or a list of either
    """

    slots: Mapping[str, Slot]
    values: Mapping[str, Sequence[Any]]
    readable: Bools

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a field of numbers; what a message lacks is NaN or 0."""
        lacking, result = (np.nan, np.float64) if self.slots[path].kind in _FLOATS else (0, np.int64)
        if "[*]" in path:
            return _padded(self.values[path], lacking, result)
        return np.array(self.values[path], result)

    def text_numbers(self, path: str, known: dict[bytes, int]) -> Ints:
        """Return the numbers of a text field's texts, -1 for none; new texts become known."""
        if "[*]" in path:
            return _padded([text_numbers(texts, known) for texts in self.values[path]], -1, np.int64)
        return np.array(text_numbers([*self.values[path]], known), np.int64)


@dataclass(slots=True)
class ValueDecoder:
    """Decodes messages one by one; of each it keeps the wanted values alone, however much it holds.

    Attributes
    ----------
    paths : by column, the field that it is made of
    parse : returns a message's nested values (mappings by field name, sequences, numbers, texts), None where it is not
        readable
    """

    slots: Mapping[str, Slot]
    paths: Mapping[str, str]
    parse: Callable[[bytes], object] = field(repr=False)

    def decode(self, block: Block, number: int) -> Iterator[tuple[Ints, DecodedValues]]:
        """Yield the rows (m,) of a block whose channel is `number`, some at a time, with what those messages hold."""
        rows = np.flatnonzero(block.channel == number)
        takers = {column: _taker(path, self.slots[column].kind) for column, path in self.paths.items()}
        for begin in range(0, len(rows), MESSAGES_AT_ONCE):
            some = rows[begin : begin + MESSAGES_AT_ONCE]
            values: dict[str, list[Any]] = {column: [] for column in self.paths}
            readable = np.zeros(len(some), np.bool_)
            for place, (start, end) in enumerate(
                zip(block.start[some].tolist(), block.end[some].tolist(), strict=True)
            ):
                if end - start > LONGEST_MESSAGE_BYTES:
                    continue
                message = self.parse(block.data[start:end].tobytes())
                if message is not None:
                    readable[place] = True
                    for column, take in takers.items():
                        values[column].append(take(message))
            yield some, DecodedValues(self.slots, values, readable)


def _taker(path: str, kind: str) -> Callable[[object], Any]:
    """Return a function of a message that takes the value, or the list of values, at a path."""
    steps = steps_of(path)
    convert = _text if kind == "string" else _float if kind in _FLOATS else _integer

    def take_all(message: object) -> list[Any]:
        values = value_at(message, steps)
        return [convert(one) for one in values] if isinstance(values, list) else []

    return take_all if "[*]" in path else lambda message: convert(value_at(message, steps))


def parse_json(data: bytes) -> dict[str, Any] | None:
    """Return a message, None where it cannot be read. NaN and Infinity, which Python writes, are numbers."""
    try:
        value = orjson.loads(data)
    except ValueError:
        if b"NaN" not in data and b"Infinity" not in data:
            return None
        try:
            value = json.loads(data)
        except (ValueError, RecursionError):
            return None
    return value if isinstance(value, dict) else None


def value_at(value: object, steps: Sequence[Step]) -> object:
    """Return what a message holds at some steps, a list behind a step to all elements; None for nothing."""
    for done, step in enumerate(steps):
        if isinstance(step, str):
            value = value.get(step) if isinstance(value, dict) else None
        elif not isinstance(value, list):
            return None
        elif step is None:
            return [value_at(one, steps[done + 1 :]) for one in value[:MOST_ELEMENTS]]
        else:
            value = value[step] if step < len(value) else None
    return value


def _float(value: object) -> float:
    if not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _integer(value: object) -> int:
    if isinstance(value, float):
        value = int(value) if math.isfinite(value) else 0
    return value if isinstance(value, int) and abs(value) < _LARGEST_INTEGER else 0


def _text(value: object) -> bytes:
    return value.encode("utf-8", "replace")[:LONGEST_TEXT] if isinstance(value, str) else b""


def _padded(rows: Sequence[Sequence[Any]], lacking: float, result: type[np.float64 | np.int64]) -> NDArray[Any]:
    """Return rows of different lengths (n, longest)."""
    padded = np.full((len(rows), max(map(len, rows), default=0)), lacking, result)
    for row, values in zip(padded, rows, strict=True):
        row[: len(values)] = values
    return padded


NMEA_SENTENCE = "nmea_msgs/Sentence"

GGA, RMC, GST, HDT = 1, 2, 3, 4
"""Kinds of sentences that are read: fix with quality, fix with validity, deviations of the fix, true heading."""

QUALITY_OF_MODE = {"A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8, "N": 0}
"""The mode indicator of RMC as the quality of GGA: autonomous, differential, PPS, RTK fixed and float, and so on."""

NMEA_FIELDS = ("latitude", "longitude", "altitude", "heading", "north_std", "east_std")
"""What the sentences hold, NaN where one does not: degrees, m above the ellipsoid, degrees clockwise from north, m."""

_SLOTS = {
    path: Slot(kind, place)
    for place, (path, kind) in enumerate(
        {"sentence_kind": "int32", "quality": "int32", **dict.fromkeys(NMEA_FIELDS, "float64")}.items()
    )
}
_SENTENCE = re.compile(rb"\s*[$!]([ -)+-~]{5,})\*([0-9A-Fa-f]{2})\s*")
_NUMBER = re.compile(r"-?\d{1,12}(?:\.\d{0,12})?")


@dataclass(slots=True)
class SentenceDecoder:
    """Decodes the messages, and the sentence in each.

    Attributes
    ----------
    inner : takes the header and the sentence's text
    """

    inner: Decoder
    slots: dict[str, Slot] = field(init=False)

    def __post_init__(self) -> None:
        self.slots = {path: slot for path, slot in self.inner.slots.items() if path != "sentence"} | _SLOTS

    def decode(self, block: Block, number: int) -> Iterator[tuple[Ints, DecodedValues]]:
        """Yield the rows (m,) of a block whose channel is `number`; a sentence with a wrong checksum is unreadable."""
        for rows, decoded in self.inner.decode(block, number):
            sentences = [parse_sentence(text) for text in decoded.texts("sentence")]
            is_one = np.array([one is not None for one in sentences], np.bool_)
            read = [one for one in sentences if one is not None]
            values: dict[str, Sequence[Any]] = {
                path: [one.get(path, 0 if slot.kind == "int32" else math.nan) for one in read]
                for path, slot in _SLOTS.items()
            }
            for path, slot in self.inner.slots.items():
                if path != "sentence":
                    column = np.array(decoded.texts(path), object) if slot.kind == "string" else decoded.numbers(path)
                    values[path] = column[is_one].tolist()
            readable = decoded.readable.copy()
            readable[readable] = is_one
            yield rows, DecodedValues(self.slots, values, readable)


def parse_sentence(text: bytes) -> dict[str, Any] | None:
    """Return what a sentence holds; None without the checksum of NMEA 0183, or with a wrong one."""
    found = _SENTENCE.fullmatch(text)
    if found is None or reduce(xor, found[1]) != int(found[2], 16):
        return None
    name, *fields = found[1].decode("ascii").split(",")
    read = _READERS.get(name[2:])
    return {} if read is None else read([*fields, *[""] * 16])


def _gga(fields: Sequence[str]) -> dict[str, Any]:
    _, north, hemisphere, east, side, quality, _, _, height, _, undulation, *_ = fields
    return {
        "sentence_kind": GGA,
        "latitude": _degrees(north, hemisphere, "NS"),
        "longitude": _degrees(east, side, "EW"),
        "altitude": _number(height) + _number(undulation or "0"),
        "quality": int(quality) if quality.isdecimal() and len(quality) == 1 else 0,
    }


def _rmc(fields: Sequence[str]) -> dict[str, Any]:
    _, status, north, hemisphere, east, side, _, _, _, _, _, mode, *_ = fields
    return {
        "sentence_kind": RMC,
        "latitude": _degrees(north, hemisphere, "NS"),
        "longitude": _degrees(east, side, "EW"),
        "quality": QUALITY_OF_MODE.get(mode, 1) if status == "A" else 0,
    }


def _gst(fields: Sequence[str]) -> dict[str, Any]:
    return {
        "sentence_kind": GST,
        "north_std": _number(fields[5]),
        "east_std": _number(fields[6]),
    }


def _hdt(fields: Sequence[str]) -> dict[str, Any]:
    return {"sentence_kind": HDT, "heading": _number(fields[0])}


_READERS: dict[str, Callable[[Sequence[str]], dict[str, Any]]] = {"GGA": _gga, "RMC": _rmc, "GST": _gst, "HDT": _hdt}


def _number(text: str) -> float:
    return float(text) if _NUMBER.fullmatch(text) else float("nan")


def _degrees(text: str, side: str, sides: str) -> float:
    """Return degrees of ``ddmm.mmmm``, negative on the second of two sides; NaN without one of them."""
    whole, minutes = divmod(_number(text), 100.0)
    return (whole + minutes / 60.0) * {sides[0]: 1.0, sides[1]: -1.0}.get(side, float("nan"))
