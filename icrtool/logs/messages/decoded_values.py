"""Messages that are decoded one by one, JSON, Protobuf and NMEA sentences: the wanted values of each, as columns.

Also which fields a channel's type has, by its schema or its definition.
"""

from __future__ import annotations

import json
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, reduce
from itertools import islice
from operator import xor
from typing import Any

import numpy as np
import orjson
from numpy.typing import NDArray

from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Bytes, Ints
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.decoder import Decoder, text_numbers
from icrtool.logs.messages.definition_bounds import MOST_FIELDS, FieldNames
from icrtool.logs.messages.definition_text import full_name
from icrtool.logs.messages.definitions import (
    BASE,
    DEEPEST,
    MOST_ELEMENTS,
    NAME,
    SEQUENCE,
    SIZES,
    Definitions,
    Step,
    decoding_steps,
    kind_at,
    ros_definitions,
)
from icrtool.logs.messages.protobuf import definitions_in, descriptors_of, field_of, protobuf_parser
from icrtool.records.text import LONGEST_TEXT, LogText

LONGEST_MESSAGE_BYTES = 1 << 20
"""Largest message that is decoded by itself [bytes]; messages that icrtool uses have some hundred bytes."""

_LARGEST_INTEGER = 1 << 62
_FLOATS = ("float32", "float64")


@dataclass(frozen=True, slots=True)
class DecodedValues:
    """Values of messages.

    Attributes
    ----------
    kinds : primitive type by column
    values : by column, the value of each readable message (n,): a number, a text, or a list of either
    """

    kinds: Mapping[str, str]
    values: Mapping[str, Sequence[Any]]
    readable: Bools

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a field of numbers; what a message lacks is NaN or 0."""
        lacking, result = (np.nan, np.float64) if self.kinds[path] in _FLOATS else (0, np.int64)
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
    """Decodes messages one by one, and keeps only the wanted values, whatever else a message holds.

    Attributes
    ----------
    kinds : primitive type by column
    paths : by column, the field that it is made of
    parse : returns a message, None where it is not readable
    field_of : returns what a message holds in a field: a message, a list, a number, a text; None for nothing
    """

    kinds: Mapping[str, str]
    paths: Mapping[str, str]
    parse: Callable[[bytes], object] = field(repr=False)
    field_of: Callable[[Any, str], object] = field(repr=False)

    def decode(self, data: Bytes, start: Ints, end: Ints) -> DecodedValues:
        """Decode messages [start, end) (n,) of `data`."""
        takers = {column: _taker(path, self.kinds[column], self.field_of) for column, path in self.paths.items()}
        values: dict[str, list[Any]] = {column: [] for column in self.paths}
        readable = np.zeros(len(start), np.bool_)
        for place, (begin, stop) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
            message = self.parse(data[begin:stop].tobytes()) if stop - begin <= LONGEST_MESSAGE_BYTES else None
            if message is not None:
                readable[place] = True
                for column, take in takers.items():
                    values[column].append(take(message))
        return DecodedValues(self.kinds, values, readable)


def _taker(path: str, kind: str, field_of: Callable[[Any, str], object]) -> Callable[[object], Any]:
    """Return a function of a message that takes the value, or the list of values, at a path."""
    steps = decoding_steps(path)
    convert = _text if kind == "string" else _float if kind in _FLOATS else _integer

    def take(message: object) -> Any:  # noqa: ANN401 - a number, a text, or a list of either
        value = value_at(message, steps, field_of)
        if "[*]" in path:
            return [convert(one) for one in value] if isinstance(value, list) else []
        return convert(value)

    return take


def parse_json_message(data: bytes) -> dict[str, Any] | None:
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


def property_of(value: object, name: str) -> object:
    """Return what a JSON value holds in a property, None where it is no object or lacks it."""
    return value.get(name) if isinstance(value, dict) else None


def value_at(value: object, steps: Sequence[Step], field_of: Callable[[Any, str], object]) -> object:
    """Return the value of a message at some steps, a list after a step to all elements; None where it has none."""
    for done, step in enumerate(steps):
        if isinstance(step, str):
            value = None if value is None else field_of(value, step)
        elif not isinstance(value, list):
            return None
        elif step is None:
            return [value_at(one, steps[done + 1 :], field_of) for one in value[:MOST_ELEMENTS]]
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
    value = value.encode("utf-8", "replace") if isinstance(value, str) else value
    return value[:LONGEST_TEXT] if isinstance(value, bytes) else b""


def _padded(rows: Sequence[Sequence[Any]], lacking: float, result: type[np.float64 | np.int64]) -> NDArray[Any]:
    """Return rows of different lengths as one array (n, longest), filled up with `lacking`."""
    padded = np.full((len(rows), max(map(len, rows), default=0)), lacking, result)
    for row, values in zip(padded, rows, strict=True):
        row[: len(values)] = values
    return padded


NMEA_SENTENCE = "nmea_msgs/Sentence"

GGA, RMC, GST, HDT = 1, 2, 4, 8
"""Kinds of sentences that are read: fix with quality, fix with validity, deviations of the fix, true heading (HDT, THS,
UNIHEADINGA). A message with several sentences has the sum of their kinds."""

QUALITY_OF_MODE = {"A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8, "N": 0}
"""The mode indicator of RMC as the quality of GGA: autonomous, differential, PPS, RTK fixed and float, and so on."""

NMEA_FIELDS = ("latitude", "longitude", "altitude", "heading", "north_std", "east_std", "heading_std")
"""Values of the sentences, NaN where a sentence has none: degrees, m above the ellipsoid, degrees clockwise from north,
m, m, degrees."""

_KINDS_OF_NMEA = {"sentence_kind": "int32", "quality": "int32", **dict.fromkeys(NMEA_FIELDS, "float64")}
_SENTENCE = re.compile(rb"\s*[$!]([ -)+-~]{5,})\*([0-9A-Fa-f]{2})\s*")
_WITHOUT_CHECKSUM = re.compile(rb"\s*[$!]([ -)+-~]{5,})\s*")
"""A sentence without a checksum."""

_LONG = re.compile(rb"\s*#([ -)+-~]{5,})\*([0-9A-Fa-f]{8})\s*")
"""A log of NovAtel and Unicore in ASCII: header, semicolon, fields, CRC of 32 bits."""

_PLAIN_NUMBER = re.compile(r"-?\d{1,12}(?:\.\d{0,12})?")


@dataclass(slots=True)
class SentenceDecoder:
    """Decodes the messages, and the sentence in each.

    Attributes
    ----------
    inner : takes the header and the sentence's text
    """

    inner: Decoder
    kinds: dict[str, str] = field(init=False)
    _has_checksums: bool = False

    def __post_init__(self) -> None:
        self.kinds = {path: kind for path, kind in self.inner.kinds.items() if path != "sentence"} | _KINDS_OF_NMEA

    def decode(self, data: Bytes, start: Ints, end: Ints) -> DecodedValues:
        """Decode messages [start, end) (n,) of `data`: the first ones, up to the limit of `inner`.

        A message with a wrong checksum is unreadable. A message without checksum is unreadable, unless no sentence of
        the topic has one.
        """
        decoded = self.inner.decode(data, start, end)
        texts = decoded.texts("sentence")
        self._has_checksums = self._has_checksums or any(_SENTENCE.search(text) for text in texts)
        sentences = [parse_sentences(text, bare=not self._has_checksums) for text in texts]
        is_one = np.array([one is not None for one in sentences], np.bool_)
        read = [one for one in sentences if one is not None]
        values: dict[str, Sequence[Any]] = {
            path: [one.get(path, 0 if kind == "int32" else math.nan) for one in read]
            for path, kind in _KINDS_OF_NMEA.items()
        }
        for path, kind in self.inner.kinds.items():
            if path != "sentence":
                column = np.array(decoded.texts(path), object) if kind == "string" else decoded.numbers(path)
                values[path] = column[is_one].tolist()
        readable = decoded.readable.copy()
        readable[readable] = is_one
        return DecodedValues(self.kinds, values, readable)


def parse_sentences(text: bytes, *, bare: bool = False) -> dict[str, Any] | None:
    """Return what the sentences of a message hold together, the first of each kind; None where none can be read.

    Parameters
    ----------
    bare : sentences without a checksum are read, too
    """
    whole: dict[str, Any] | None = None
    lines = text.splitlines()
    # if a message is longer than the bytes that are read, its last sentence is incomplete
    for line in lines if len(text) < LONGEST_TEXT else lines[:-1]:
        if (sentence := parse_sentence(line, bare=bare)) is not None:
            whole = whole or {}
            kinds = whole.get("sentence_kind", 0) | sentence.get("sentence_kind", 0)
            # The position of a GGA has a height: it is preferred to the position of an RMC.
            is_better = sentence.get("sentence_kind") == GGA
            whole = ({**whole, **sentence} if is_better else {**sentence, **whole}) | (
                {"sentence_kind": kinds} if kinds else {}
            )
    return whole


def parse_sentence(text: bytes, *, bare: bool = False) -> dict[str, Any] | None:
    """Return what a sentence holds; None without the checksum of NMEA 0183, or with a wrong one.

    Parameters
    ----------
    bare : a sentence without a checksum is read, too
    """
    if (long := _LONG.fullmatch(text)) is not None:
        return _parse_long(long[1].decode("ascii")) if _crc_of(long[1]) == int(long[2], 16) else None
    match = _SENTENCE.fullmatch(text)
    is_right = match is not None and reduce(xor, match[1]) == int(match[2], 16)
    match = match or (_WITHOUT_CHECKSUM.fullmatch(text) if bare else None)
    return (
        _fields_of(match[1].decode("ascii"))
        if match is not None and (is_right or match.re is _WITHOUT_CHECKSUM)
        else None
    )


def _fields_of(text: str) -> dict[str, Any]:
    """Return what the text of a sentence between sign and checksum holds."""
    name, *fields = text.split(",")
    fields += [""] * 16
    match name[2:]:
        case "GGA":
            _, north, hemisphere, east, side, quality, _, _, height, _, undulation, *_ = fields
            return {
                "sentence_kind": GGA,
                "latitude": _degrees(north, hemisphere, "NS"),
                "longitude": _degrees(east, side, "EW"),
                "altitude": _number(height) + _number(undulation or "0"),
                "quality": int(quality) if quality.isdecimal() and len(quality) == 1 else 0,
            }
        case "RMC":
            _, status, north, hemisphere, east, side, _, _, _, _, _, mode, *_ = fields
            return {
                "sentence_kind": RMC,
                "latitude": _degrees(north, hemisphere, "NS"),
                "longitude": _degrees(east, side, "EW"),
                "quality": QUALITY_OF_MODE.get(mode, 1) if status == "A" else 0,
            }
        case "GST":
            return {"sentence_kind": GST, "north_std": _number(fields[5]), "east_std": _number(fields[6])}
        case "HDT":
            return {"sentence_kind": HDT, "heading": _number(fields[0])}
        case "THS":
            return {"sentence_kind": HDT, "heading": _number(fields[0]) if fields[1] in ("A", "") else math.nan}
        case _:
            return {}


def _parse_long(text: str) -> dict[str, Any]:
    """Return the heading of UNIHEADINGA and HEADINGA, NaN where it is not solved; nothing of other logs."""
    head, _, body = text.partition(";")
    if head.partition(",")[0] not in ("UNIHEADINGA", "HEADINGA", "HEADING2A"):
        return {}
    solution, kind, _, heading, _, _, std, *_ = [*body.split(","), *[""] * 8]
    is_solved = solution == "SOL_COMPUTED" and kind != "NONE"
    return {
        "sentence_kind": HDT, "heading": _number(heading) if is_solved else math.nan, "heading_std": _number(std),
    }  # fmt: skip


def _crc_of(text: bytes) -> int:
    """Return the CRC of a log of NovAtel and Unicore: CRC-32 that begins with 0 and is not inverted."""
    return zlib.crc32(text, 0xFFFFFFFF) ^ 0xFFFFFFFF


def _number(text: str) -> float:
    return float(text) if _PLAIN_NUMBER.fullmatch(text) else float("nan")


_MINUTES = 60.0
"""Largest number of minutes; a receiver that rounds may write 60."""


def _degrees(text: str, side: str, sides: str) -> float:
    """Return degrees of ``ddmm.mmmm``, negative on the second of two sides; NaN without one of them."""
    whole, minutes = divmod(_number(text), 100.0)
    if not (whole >= 0.0 and minutes <= _MINUTES):
        return float("nan")  # the side is a letter, not a sign
    return (whole + minutes / 60.0) * {sides[0]: 1.0, sides[1]: -1.0}.get(side, float("nan"))


LONGEST_SCHEMA = 1 << 20
"""Characters of the longest JSON schema that is read."""

_KINDS = {"integer": "int64", "number": "float64", "boolean": "bool", "string": "string"}
_OTHER_NAMES = {
    "header.stamp.sec": ("timestamp.sec", "timestamp.seconds"),
    "header.stamp.nanosec": ("timestamp.nsec", "timestamp.nanos", "header.stamp.nsec"),
    "header.frame_id": ("frame_id",),
}
"""Fields of JSON and Protobuf that stand for the fields of a ROS header."""

_FOXGLOVE_KINDS = {"frame_id": "string", "name": "string", "sec": "int64", "nsec": "int64"}
"""Types of fields in Foxglove's schemas, for JSON that states no types; other fields are float64."""

_MOST_PATHS = 512
"""Largest number of fields of an unknown type that are listed."""

_MOST_NESTED = 3
"""Largest depth of nested messages of an unknown type that are searched."""


def value_decoder(channel: Channel, wanted: tuple[str, ...]) -> ValueDecoder:
    """Return the decoder of Protobuf or JSON; if a JSON schema lists no fields, all wanted ones are looked for."""
    paths, kinds = _columns_of(replace(channel, id=0, topic=LogText(""), count=None), wanted)
    if channel.encoding == "json":
        return ValueDecoder(kinds, paths, parse_json_message, property_of)
    descriptors = descriptors_of(channel.definition, channel.message_type)
    parse = protobuf_parser(descriptors, channel.message_type, map(decoding_steps, paths.values()))
    return ValueDecoder(kinds, paths, parse, field_of)


@lru_cache(maxsize=64)
def _columns_of(alike: Channel, wanted: tuple[str, ...]) -> tuple[dict[str, str], dict[str, str]]:
    """Return, by column, the path that it is made of and its type, in channels that are alike."""
    definitions = _definitions_of(alike)
    paths: dict[str, str] = {}
    kinds: dict[str, str] = {}
    for column in wanted:
        others = _OTHER_NAMES.get(column, ())
        for path in (column, *others) if definitions else others[:1] or (column,):
            if definitions:
                kind = kind_at(definitions, full_name(alike.message_type), decoding_steps(path))
            else:
                kind = _FOXGLOVE_KINDS.get(path.rpartition(".")[2], "float64")
            if kind is not None:
                paths[column], kinds[column] = path, kind
                break
    return paths, kinds


@lru_cache(maxsize=64)
def definitions_in_schema(text: str, message_type: str) -> Definitions:
    """Return the message types of a channel's JSON schema, in the form of ROS types; none where it lists no fields.

    Raises
    ------
    DefinitionError
        The schema cannot be read, or is too large.
    """
    if len(text) > LONGEST_SCHEMA:
        raise DefinitionError(message_type, f"the schema in the log has more than {LONGEST_SCHEMA} characters")
    try:
        schema = orjson.loads(text) if text.strip() else {}
    except ValueError as err:
        raise DefinitionError(message_type, "the schema in the log is no JSON") from err
    definitions: dict[str, tuple[Any, Any]] = {}
    _count(schema, [], FieldNames(message_type))
    _add(definitions, full_name(message_type), schema, 0)
    return definitions


def _count(schema: object, within: list[str], names: FieldNames) -> int:
    """Return how many fields an object has, with the fields of the objects in it.

    Raises
    ------
    DefinitionError
        They are too many, or their names too long.
    """
    properties = schema.get("properties") if isinstance(schema, dict) else None
    if not isinstance(properties, dict) or len(within) > DEEPEST:
        return 0
    fields = 0
    for part, described in properties.items():
        names.add(*within, part)
        inner = described.get("items") if _kind(described) == "array" else described
        fields += 1 + (_count(inner, [*within, part], names) if _kind(inner) == "object" else 0)
        if fields > MOST_FIELDS:
            why = f"its schema has more than {MOST_FIELDS} fields"
            raise DefinitionError(names.message_type, why, "it is not read")
    return fields


def _add(definitions: dict[str, tuple[Any, Any]], name: str, schema: object, depth: int) -> None:
    """Add the fields of an object, and the types of fields that are objects."""
    properties = schema.get("properties") if isinstance(schema, dict) else None
    if not isinstance(properties, dict) or depth > DEEPEST:
        return
    fields: list[tuple[str, tuple[int, Any]]] = []
    definitions[name] = ([], fields)
    for part, described in properties.items():
        inner = f"{name}.{part}"
        is_list = _kind(described) == "array"
        if is_list:
            described = described.get("items")  # noqa: PLW2901 - the elements are described as a field is
        kind = _kind(described)
        one = (NAME, inner) if kind == "object" else (BASE, (_KINDS.get(kind, "float64"), 0))
        fields.append((part, (SEQUENCE, (one, 0)) if is_list else one))
        if kind == "object":
            _add(definitions, inner, described, depth + 1)


def _kind(described: object) -> str:
    """Return the type that a schema states; empty where it states none, as for an enumeration, read as a number."""
    if not isinstance(described, dict):
        return ""
    kind = described.get("type", "object" if "properties" in described else None)
    kinds = [one for one in (kind if isinstance(kind, list) else [kind]) if one != "null"]
    return kinds[0] if kinds and isinstance(kinds[0], str) else ""


def _definitions_of(channel: Channel) -> Definitions:
    if channel.encoding == "protobuf":
        return definitions_in(descriptors_of(channel.definition, channel.message_type))
    if channel.encoding == "json":
        return definitions_in_schema(channel.definition, channel.message_type)
    return ros_definitions(channel)


def number_fields(channel: Channel) -> list[str]:
    """Return the paths of the plain numbers in a channel's messages; empty where its type is not known."""
    try:
        definitions = _definitions_of(channel)
    except DefinitionError:
        return []
    return list(islice(_numbers_in(definitions, full_name(channel.message_type), "", 0), _MOST_PATHS))


def _numbers_in(definitions: Definitions, name: str, prefix: str, depth: int) -> Iterator[str]:
    for named, (node, detail) in definitions[name][1] if name in definitions else ():
        if int(node) == BASE and detail[0] in SIZES:
            yield f"{prefix}{named}"
        elif int(node) == NAME and depth < _MOST_NESTED:
            yield from _numbers_in(definitions, detail, f"{prefix}{named}.", depth + 1)
