"""NMEA 0183 sentences in nmea_msgs/Sentence: one row for each, with what GGA, RMC, GST and HDT state."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import reduce
from operator import xor
from typing import Any

import numpy as np

from icrtool.kernels.arrays import Ints
from icrtool.logs.containers.channel import Block
from icrtool.logs.messages.decoded_values import DecodedValues
from icrtool.logs.messages.decoder import Decoder
from icrtool.logs.messages.schema import Slot

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
