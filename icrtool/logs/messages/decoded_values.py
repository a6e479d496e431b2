"""Decoders of messages that are read one by one: JSON, Protobuf and NMEA sentences.

Each decoder returns the wanted values of all messages as columns. `number_fields` lists the fields of a message type.
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
from icrtool.logs.messages.decoder import Decoder, text_codes
from icrtool.logs.messages.definition_bounds import MOST_FIELDS, NameBudget
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
    primitive_type_at,
    ros_definitions,
)
from icrtool.logs.messages.protobuf import definitions_in, descriptors_of, field_of, protobuf_parser
from icrtool.records.text import LONGEST_TEXT, LogText

LONGEST_MESSAGE_BYTES = 1 << 20
"""Largest message that is decoded by itself [bytes]. The messages that icrtool uses have some hundred bytes."""

_LARGEST_INTEGER = 1 << 62
"""Limit of whole numbers; a number that is larger, or smaller than its negative, is read as 0."""

_FLOATS = ("float32", "float64")


@dataclass(frozen=True, slots=True)
class DecodedValues:
    """Values of messages that were decoded one by one.

    Attributes
    ----------
    types : primitive type of each column
    values : for each column the value of each readable message (n,): a number, a text, or a list of either
    readable : (m,) whether each message could be decoded
    """

    types: Mapping[str, str]
    values: Mapping[str, Sequence[Any]]
    readable: Bools

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a field of numbers (n,), or (n, longest) for a list; NaN or 0 where a message lacks the number."""
        fill, dtype = (np.nan, np.float64) if self.types[path] in _FLOATS else (0, np.int64)
        if "[*]" in path:
            return _padded(self.values[path], fill, dtype)
        return np.array(self.values[path], dtype)

    def text_codes(self, path: str, known: dict[bytes, int]) -> Ints:
        """Return the code of each text of a text field (n,) or (n, longest), -1 where a message lacks the text.

        Parameters
        ----------
        path : path of the field
        known : code of each text, from 0; texts that are not in it are added
        """
        if "[*]" in path:
            return _padded([text_codes(texts, known) for texts in self.values[path]], -1, np.int64)
        return np.array(text_codes([*self.values[path]], known), np.int64)


@dataclass(slots=True)
class ValueDecoder:
    """Decoder of JSON or Protobuf messages that keeps only the wanted values.

    Attributes
    ----------
    types : primitive type of each column
    paths : for each column the path of its field in a message
    parse : returns the parsed message, None where the bytes are not readable
    field_of : returns the value of a field of a message: a message, a list, a number or a text; None without a value
    """

    types: Mapping[str, str]
    paths: Mapping[str, str]
    parse: Callable[[bytes], object] = field(repr=False)
    field_of: Callable[[Any, str], object] = field(repr=False)

    def decode(self, data: Bytes, start: Ints, end: Ints) -> DecodedValues:
        """Decode messages [start, end) (n,) of `data`."""
        readers = {
            column: _value_reader(path, self.types[column], self.field_of) for column, path in self.paths.items()
        }
        values: dict[str, list[Any]] = {column: [] for column in self.paths}
        readable = np.zeros(len(start), np.bool_)
        for row, (begin, stop) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
            message = self.parse(data[begin:stop].tobytes()) if stop - begin <= LONGEST_MESSAGE_BYTES else None
            if message is not None:
                readable[row] = True
                for column, read_value in readers.items():
                    values[column].append(read_value(message))
        return DecodedValues(self.types, values, readable)


def _value_reader(path: str, primitive: str, field_of: Callable[[Any, str], object]) -> Callable[[object], Any]:
    """Return a function that returns the value, or the list of values, of a message at a path."""
    steps = decoding_steps(path)
    convert = _as_text if primitive == "string" else _as_float if primitive in _FLOATS else _as_integer

    def read_value(message: object) -> Any:  # noqa: ANN401 - a number, a text, or a list of either
        value = value_at(message, steps, field_of)
        if "[*]" in path:
            return [convert(element) for element in value] if isinstance(value, list) else []
        return convert(value)

    return read_value


def parse_json_message(data: bytes) -> dict[str, Any] | None:
    """Return a JSON object, None where the text is no JSON object. NaN and Infinity, which Python writes, are read."""
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
    """Return the value of a property of a JSON object, None where the object lacks it or the value is no object."""
    return value.get(name) if isinstance(value, dict) else None


def value_at(value: object, steps: Sequence[Step], field_of: Callable[[Any, str], object]) -> object:
    """Return the value of a message at the end of some steps; None where the message has no value there.

    After a step to all elements (None) the value is the list of the elements' values.
    """
    for depth, step in enumerate(steps):
        if isinstance(step, str):
            value = None if value is None else field_of(value, step)
        elif not isinstance(value, list):
            return None
        elif step is None:
            return [value_at(element, steps[depth + 1 :], field_of) for element in value[:MOST_ELEMENTS]]
        else:
            value = value[step] if step < len(value) else None
    return value


def _as_float(value: object) -> float:
    """Return a number as a float; NaN where the value is no number, infinity where it is too large."""
    if not isinstance(value, (int, float)):
        return math.nan
    try:
        return float(value)
    except OverflowError:
        return math.inf if value > 0 else -math.inf


def _as_integer(value: object) -> int:
    """Return a number without its decimals; 0 where the value is no number, or beyond `_LARGEST_INTEGER`."""
    if isinstance(value, float):
        value = int(value) if math.isfinite(value) else 0
    return value if isinstance(value, int) and abs(value) < _LARGEST_INTEGER else 0


def _as_text(value: object) -> bytes:
    """Return the first `LONGEST_TEXT` bytes of a text as UTF-8; empty where the value is no text."""
    value = value.encode("utf-8", "replace") if isinstance(value, str) else value
    return value[:LONGEST_TEXT] if isinstance(value, bytes) else b""


def _padded(rows: Sequence[Sequence[Any]], fill: float, dtype: type[np.float64 | np.int64]) -> NDArray[Any]:
    """Return rows of different lengths as one array (n, longest); short rows end with `fill`."""
    padded = np.full((len(rows), max(map(len, rows), default=0)), fill, dtype)
    for row, values in zip(padded, rows, strict=True):
        row[: len(values)] = values
    return padded


NMEA_SENTENCE = "nmea_msgs/Sentence"
"""Message type that holds sentences of NMEA 0183."""

GGA, RMC, GST, HDT = 1, 2, 4, 8
"""Kinds of sentences that are read. GGA: a fix with its quality. RMC: a fix with its validity. GST: standard deviations
of the fix. HDT: a true heading (HDT, THS, UNIHEADINGA). A message with several sentences has the sum of their kinds."""

QUALITY_OF_MODE = {"A": 1, "D": 2, "P": 3, "R": 4, "F": 5, "E": 6, "M": 7, "S": 8, "N": 0}
"""GGA quality of each mode indicator of RMC: autonomous 1, differential 2, PPS 3, RTK fixed 4, RTK float 5, and so
on."""

NMEA_FIELDS = ("latitude", "longitude", "altitude", "heading", "north_std", "east_std", "heading_std")
"""Columns of the values of the sentences; NaN where a sentence lacks the value. Latitude and longitude [deg], altitude
above the ellipsoid [m], heading clockwise from north [deg], standard deviations [m], [m] and [deg]."""

_NMEA_TYPES = {"sentence_kind": "int32", "quality": "int32", **dict.fromkeys(NMEA_FIELDS, "float64")}
_SENTENCE = re.compile(rb"\s*[$!]([ -)+-~]{5,})\*([0-9A-Fa-f]{2})\s*")
_WITHOUT_CHECKSUM = re.compile(rb"\s*[$!]([ -)+-~]{5,})\s*")
"""Pattern of a sentence without a checksum."""

_LONG_SENTENCE = re.compile(rb"\s*#([ -)+-~]{5,})\*([0-9A-Fa-f]{8})\s*")
"""Pattern of an ASCII log of NovAtel or Unicore: header, semicolon, fields, CRC of 32 bits."""

_PLAIN_NUMBER = re.compile(r"-?\d{1,12}(?:\.\d{0,12})?")


@dataclass(slots=True)
class SentenceDecoder:
    """Decoder of messages that hold an NMEA sentence as a text.

    Attributes
    ----------
    inner : decoder of the header and of the text of the sentence
    types : primitive type of each column
    """

    inner: Decoder
    types: dict[str, str] = field(init=False)
    _has_checksums: bool = False

    def __post_init__(self) -> None:
        self.types = {
            path: primitive for path, primitive in self.inner.types.items() if path != "sentence"
        } | _NMEA_TYPES

    def decode(self, data: Bytes, start: Ints, end: Ints) -> DecodedValues:
        """Return the decoded messages [start, end) (n,) of `data`; only the first messages if `inner` reaches a limit.

        A message with a wrong checksum is unreadable. A message without a checksum is unreadable, unless no sentence of
        the topic has a checksum.
        """
        decoded = self.inner.decode(data, start, end)
        texts = decoded.texts("sentence")
        self._has_checksums = self._has_checksums or any(_SENTENCE.search(text) for text in texts)
        sentences = [parse_sentences(text, without_checksum=not self._has_checksums) for text in texts]
        is_sentence = np.array([sentence is not None for sentence in sentences], np.bool_)
        parsed = [sentence for sentence in sentences if sentence is not None]
        values: dict[str, Sequence[Any]] = {
            path: [sentence.get(path, 0 if primitive == "int32" else math.nan) for sentence in parsed]
            for path, primitive in _NMEA_TYPES.items()
        }
        for path, primitive in self.inner.types.items():
            if path != "sentence":
                column = np.array(decoded.texts(path), object) if primitive == "string" else decoded.numbers(path)
                values[path] = column[is_sentence].tolist()
        readable = decoded.readable.copy()
        readable[readable] = is_sentence
        return DecodedValues(self.types, values, readable)


def parse_sentences(text: bytes, *, without_checksum: bool = False) -> dict[str, Any] | None:
    """Return the values of all sentences of a message, by the names of the columns; None where none can be read.

    Parameters
    ----------
    without_checksum : whether sentences without a checksum are read, too
    """
    merged: dict[str, Any] | None = None
    lines = text.splitlines()
    # If a message is longer than the bytes that are read, its last sentence is incomplete.
    for line in lines if len(text) < LONGEST_TEXT else lines[:-1]:
        if (sentence := parse_sentence(line, without_checksum=without_checksum)) is not None:
            merged = merged or {}
            kinds = merged.get("sentence_kind", 0) | sentence.get("sentence_kind", 0)
            # The position of a GGA has a height: it is preferred to the position of an RMC.
            is_better = sentence.get("sentence_kind") == GGA
            merged = ({**merged, **sentence} if is_better else {**sentence, **merged}) | (
                {"sentence_kind": kinds} if kinds else {}
            )
    return merged


def parse_sentence(text: bytes, *, without_checksum: bool = False) -> dict[str, Any] | None:
    """Return the values of a sentence, by the names of the columns; None where its checksum is missing or wrong.

    Parameters
    ----------
    without_checksum : whether a sentence without a checksum is read, too

    Notes
    -----
    NMEA 0183: the checksum is the exclusive or of all bytes between the sign and the asterisk.
    """
    if (match := _LONG_SENTENCE.fullmatch(text)) is not None:
        return _parse_long_sentence(match[1].decode("ascii")) if _crc32_of(match[1]) == int(match[2], 16) else None
    match = _SENTENCE.fullmatch(text)
    is_right = match is not None and reduce(xor, match[1]) == int(match[2], 16)
    match = match or (_WITHOUT_CHECKSUM.fullmatch(text) if without_checksum else None)
    return (
        _fields_of(match[1].decode("ascii"))
        if match is not None and (is_right or match.re is _WITHOUT_CHECKSUM)
        else None
    )


def _fields_of(text: str) -> dict[str, Any]:
    """Return the values of a sentence, given the text between its sign and its checksum."""
    name, *fields = text.split(",")
    fields += [""] * 16
    match name[2:]:
        case "GGA":
            _, north, hemisphere, east, side, quality, _, _, height, _, undulation, *_ = fields
            return {
                "sentence_kind": GGA,
                "latitude": _parse_degrees(north, hemisphere, "NS"),
                "longitude": _parse_degrees(east, side, "EW"),
                "altitude": _parse_number(height) + _parse_number(undulation or "0"),
                "quality": int(quality) if quality.isdecimal() and len(quality) == 1 else 0,
            }
        case "RMC":
            _, status, north, hemisphere, east, side, _, _, _, _, _, mode, *_ = fields
            return {
                "sentence_kind": RMC,
                "latitude": _parse_degrees(north, hemisphere, "NS"),
                "longitude": _parse_degrees(east, side, "EW"),
                "quality": QUALITY_OF_MODE.get(mode, 1) if status == "A" else 0,
            }
        case "GST":
            return {"sentence_kind": GST, "north_std": _parse_number(fields[5]), "east_std": _parse_number(fields[6])}
        case "HDT":
            return {"sentence_kind": HDT, "heading": _parse_number(fields[0])}
        case "THS":
            return {"sentence_kind": HDT, "heading": _parse_number(fields[0]) if fields[1] in ("A", "") else math.nan}
        case _:
            return {}


def _parse_long_sentence(text: str) -> dict[str, Any]:
    """Return the heading of UNIHEADINGA and HEADINGA, NaN without a solution; no value of other logs."""
    head, _, body = text.partition(";")
    if head.partition(",")[0] not in ("UNIHEADINGA", "HEADINGA", "HEADING2A"):
        return {}
    solution, position_type, _, heading, _, _, std, *_ = [*body.split(","), *[""] * 8]
    is_solved = solution == "SOL_COMPUTED" and position_type != "NONE"
    return {
        "sentence_kind": HDT,
        "heading": _parse_number(heading) if is_solved else math.nan,
        "heading_std": _parse_number(std),
    }


def _crc32_of(text: bytes) -> int:
    """Return the CRC-32 of a log of NovAtel or Unicore: the register begins with 0, and the result is not inverted."""
    return zlib.crc32(text, 0xFFFFFFFF) ^ 0xFFFFFFFF


def _parse_number(text: str) -> float:
    """Return the number that a field states; NaN where it states none."""
    return float(text) if _PLAIN_NUMBER.fullmatch(text) else float("nan")


_MOST_MINUTES = 60.0
"""Largest number of minutes of an angle; a receiver that rounds may write 60."""


def _parse_degrees(text: str, side: str, sides: str) -> float:
    """Return an angle ``ddmm.mmmm`` in degrees, negative on the second of two sides; NaN if it is wrong."""
    degrees, minutes = divmod(_parse_number(text), 100.0)
    if not (degrees >= 0.0 and minutes <= _MOST_MINUTES):
        return float("nan")
    return (degrees + minutes / 60.0) * {sides[0]: 1.0, sides[1]: -1.0}.get(side, float("nan"))


LONGEST_SCHEMA = 1 << 20
"""Largest number of characters of a JSON schema that is read."""

_JSON_TYPES = {"integer": "int64", "number": "float64", "boolean": "bool", "string": "string"}
_OTHER_NAMES = {
    "header.stamp.sec": ("timestamp.sec", "timestamp.seconds"),
    "header.stamp.nanosec": ("timestamp.nsec", "timestamp.nanos", "header.stamp.nsec"),
    "header.frame_id": ("frame_id",),
}
"""Fields of JSON and Protobuf that stand for the fields of a ROS header."""

_FOXGLOVE_TYPES = {"frame_id": "string", "name": "string", "sec": "int64", "nsec": "int64"}
"""Types of fields in Foxglove's schemas, for JSON that states no types; other fields are float64."""

_MOST_PATHS = 512
"""Largest number of fields of an unknown type that are listed."""

_MOST_NESTED = 3
"""Largest depth of nested messages of an unknown type that are searched."""


def value_decoder(channel: Channel, wanted: tuple[str, ...]) -> ValueDecoder:
    """Return the decoder of a channel of Protobuf or JSON messages.

    If a JSON schema lists no fields, each message is searched for all wanted fields.

    Raises
    ------
    DefinitionError
        The schema of the channel cannot be read.
    """
    paths, types = _columns_of(replace(channel, id=0, topic=LogText(""), count=None), wanted)
    if channel.encoding == "json":
        return ValueDecoder(types, paths, parse_json_message, property_of)
    descriptors = descriptors_of(channel.definition, channel.message_type)
    parse = protobuf_parser(descriptors, channel.message_type, map(decoding_steps, paths.values()))
    return ValueDecoder(types, paths, parse, field_of)


@lru_cache(maxsize=64)
def _columns_of(channel: Channel, wanted: tuple[str, ...]) -> tuple[dict[str, str], dict[str, str]]:
    """Return the path of the field of each column, and its primitive type, for all channels with this definition."""
    definitions = _definitions_of(channel)
    paths: dict[str, str] = {}
    types: dict[str, str] = {}
    for column in wanted:
        others = _OTHER_NAMES.get(column, ())
        for path in (column, *others) if definitions else others[:1] or (column,):
            if definitions:
                primitive = primitive_type_at(definitions, full_name(channel.message_type), decoding_steps(path))
            else:
                primitive = _FOXGLOVE_TYPES.get(path.rpartition(".")[2], "float64")
            if primitive is not None:
                paths[column], types[column] = path, primitive
                break
    return paths, types


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
    _count_fields(schema, [], NameBudget(message_type))
    _add_definition(definitions, full_name(message_type), schema, 0)
    return definitions


def _count_fields(schema: object, within: list[str], names: NameBudget) -> int:
    """Return the number of fields of an object, with the fields of the objects in it.

    Raises
    ------
    DefinitionError
        The object has too many fields, or their names are too long.
    """
    properties = schema.get("properties") if isinstance(schema, dict) else None
    if not isinstance(properties, dict) or len(within) > DEEPEST:
        return 0
    count = 0
    for name, field_schema in properties.items():
        names.add(*within, name)
        inner = field_schema.get("items") if _stated_type(field_schema) == "array" else field_schema
        count += 1 + (_count_fields(inner, [*within, name], names) if _stated_type(inner) == "object" else 0)
        if count > MOST_FIELDS:
            why = f"its schema has more than {MOST_FIELDS} fields"
            raise DefinitionError(names.message_type, why, "it is not read")
    return count


def _add_definition(definitions: dict[str, tuple[Any, Any]], name: str, schema: object, depth: int) -> None:
    """Add the definition of an object, and the definitions of its fields that are objects."""
    properties = schema.get("properties") if isinstance(schema, dict) else None
    if not isinstance(properties, dict) or depth > DEEPEST:
        return
    fields: list[tuple[str, tuple[int, Any]]] = []
    definitions[name] = ([], fields)
    for field_name, field_schema in properties.items():
        inner = f"{name}.{field_name}"
        is_list = _stated_type(field_schema) == "array"
        if is_list:
            field_schema = field_schema.get("items")  # noqa: PLW2901 - the elements are described as a field is
        stated = _stated_type(field_schema)
        element = (NAME, inner) if stated == "object" else (BASE, (_JSON_TYPES.get(stated, "float64"), 0))
        fields.append((field_name, (SEQUENCE, (element, 0)) if is_list else element))
        if stated == "object":
            _add_definition(definitions, inner, field_schema, depth + 1)


def _stated_type(schema: object) -> str:
    """Return the type that a schema states; empty where it states none: an enumeration, which is read as a number."""
    if not isinstance(schema, dict):
        return ""
    stated = schema.get("type", "object" if "properties" in schema else None)
    names = [name for name in (stated if isinstance(stated, list) else [stated]) if name != "null"]
    return names[0] if names and isinstance(names[0], str) else ""


def _definitions_of(channel: Channel) -> Definitions:
    """Return the definitions of a channel's type and of all types in it, from its schema or its ROS definition."""
    if channel.encoding == "protobuf":
        return definitions_in(descriptors_of(channel.definition, channel.message_type))
    if channel.encoding == "json":
        return definitions_in_schema(channel.definition, channel.message_type)
    return ros_definitions(channel)


def number_fields(channel: Channel) -> list[str]:
    """Return the paths of the fields of a channel's type that are single numbers; empty where its type is not known."""
    try:
        definitions = _definitions_of(channel)
    except DefinitionError:
        return []
    return list(islice(_number_paths(definitions, full_name(channel.message_type), "", 0), _MOST_PATHS))


def _number_paths(definitions: Definitions, name: str, prefix: str, depth: int) -> Iterator[str]:
    """Yield the paths of the numbers in a type, each behind `prefix`, and in the types of its fields."""
    for named, (node, detail) in definitions[name][1] if name in definitions else ():
        if int(node) == BASE and detail[0] in SIZES:
            yield f"{prefix}{named}"
        elif int(node) == NAME and depth < _MOST_NESTED:
            yield from _number_paths(definitions, detail, f"{prefix}{named}.", depth + 1)
