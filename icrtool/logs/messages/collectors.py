"""What gathers the columns of a channel: its decoder, by message type and by how messages are serialized."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Bools, Ints
from icrtool.logs.containers.channel import Block, Channel
from icrtool.logs.messages.decoded_values import (
    NMEA_SENTENCE,
    MessageDecoder,
    SentenceDecoder,
    ValueDecoder,
    parse_json,
)
from icrtool.logs.messages.decoder import Decoded, Decoder, ros_decoder
from icrtool.logs.messages.definitions import definitions_of, full_name, kind_at
from icrtool.logs.messages.protobuf import ProtobufParser, descriptors_of
from icrtool.logs.messages.schema import Slot, steps_of
from icrtool.logs.messages.topic_table import HEADER, TopicCollector

DYNAMIC_JOINT_STATE = "control_msgs/DynamicJointState"
_NAMES, _INTERFACES, _VALUES = "joint_names[*]", "interface_values[*].interface_names", "interface_values[*].values"


@dataclass(frozen=True, slots=True)
class InterfaceDecoder:
    """Decodes messages of DynamicJointState as those of a JointState; NaN where a joint has no such interface.

    Attributes
    ----------
    inner : takes the header, the joints' names, and the names and values of all their interfaces in a row
    """

    inner: Decoder

    @property
    def slots(self) -> dict[str, Slot]:
        """The wanted fields that the messages have, by path."""
        made = {"name[*]": Slot("string", 0), "position[*]": Slot("float64", 1), "velocity[*]": Slot("float64", 2)}
        return {path: slot for path, slot in self.inner.slots.items() if path in HEADER} | made

    def decode(self, block: Block, number: int) -> Iterator[tuple[Ints, JointColumns]]:
        """Yield the rows (m,) of a block whose channel is `number`, some at a time, with what those messages hold."""
        for rows, decoded in self.inner.decode(block, number):
            yield rows, JointColumns(decoded)


@dataclass(frozen=True, slots=True)
class JointColumns:
    """Some messages of DynamicJointState with the columns of a JointState."""

    inner: Decoded

    @property
    def readable(self) -> Bools:
        """Which of the messages given (m,) are readable."""
        return self.inner.readable

    def text_numbers(self, path: str, known: dict[bytes, int]) -> Ints:
        """Return the numbers of a text field's texts; new texts become known."""
        return self.inner.text_numbers(_NAMES if path == "name[*]" else path, known)

    def numbers(self, path: str) -> NDArray[Any]:
        """Return a field of the header, or the interface of each joint that the path names (n, longest)."""
        if path in HEADER:
            return self.inner.numbers(path)
        texts: dict[bytes, int] = {}
        joints = self.inner.text_numbers(_NAMES, texts).shape[1]
        interfaces = self.inner.text_numbers(f"{_INTERFACES}[*]", texts)
        values = self.inner.numbers(f"{_VALUES}[*]")
        named, valued = (self.inner.numbers(f"{of}[#]")[:, :joints] for of in (_INTERFACES, _VALUES))
        wanted, column = texts.get(path.removesuffix("[*]").encode(), -2), np.full((len(values), joints), np.nan)
        for _, some in self.inner.by_shape():
            # messages of a shape have as many interfaces of each joint: their places in a row are the same
            rows = np.arange(len(values))[some]
            joint, name, value = _interface_places(named[rows[0]], valued[rows[0]])
            taken = (name < interfaces.shape[1]) & (value < values.shape[1])
            joint, name, value = joint[taken], name[taken], value[taken]
            row, place = np.nonzero(interfaces[np.ix_(rows, name)] == wanted)
            column[rows[row], joint[place]] = values[rows[row], value[place]]
        return column


def _interface_places(named: Ints, valued: Ints) -> tuple[Ints, Ints, Ints]:
    """Return the joint of each interface (k,), and its place among the names, and among the values, of all joints.

    Parameters
    ----------
    named, valued : how many names, and values, of each joint there are (n,)
    """
    both = np.minimum(named, valued)
    joint = np.repeat(np.arange(len(both)), both)
    place = np.arange(len(joint)) - np.repeat(np.cumsum(both) - both, both)
    return joint, (np.cumsum(named) - named)[joint] + place, (np.cumsum(valued) - valued)[joint] + place


READ_ENCODINGS = ("cdr", "ros1", "protobuf", "json")
"""Serializations of messages that are read: of ROS 2, of ROS 1, and those of Foxglove."""

_OTHER_NAMES = {
    "header.stamp.sec": ("timestamp.sec", "timestamp.seconds"),
    "header.stamp.nanosec": ("timestamp.nsec", "timestamp.nanos", "header.stamp.nsec"),
    "header.frame_id": ("frame_id",),
}
"""Fields that stand for those of a ROS header in JSON and in Protobuf."""


def collector_for(channel: Channel, wanted: tuple[str, ...], before: TopicCollector | None = None) -> TopicCollector:
    """Return what gathers the wanted columns of a channel: `before`, where another one of the topic came already.

    Raises
    ------
    DefinitionError
        The layout of the channel's type is not known, or its serialization is not read.
    """
    if channel.encoding not in READ_ENCODINGS:
        raise DefinitionError(channel.topic, f"serialization {str(channel.encoding)!r} is not read")
    collector = before if before is not None else TopicCollector(channel)
    decoder: MessageDecoder
    if channel.message_type == DYNAMIC_JOINT_STATE:
        decoder = _interface_decoder(channel)
    elif channel.encoding in ("protobuf", "json"):
        decoder = _value_decoder(channel, wanted)
    elif channel.message_type == NMEA_SENTENCE:
        decoder = SentenceDecoder(ros_decoder(channel, (*HEADER, "sentence")))
    else:
        decoder = ros_decoder(channel, wanted)
    collector.decoders[channel.id] = decoder
    return collector


def _interface_decoder(channel: Channel) -> InterfaceDecoder:
    if channel.encoding not in ("cdr", "ros1"):
        raise DefinitionError(channel.topic, f"its lists within lists are not read in {str(channel.encoding)!r}")
    decoder = ros_decoder(
        channel, (*HEADER, _NAMES, *(f"{of}[{each}]" for of in (_INTERFACES, _VALUES) for each in "*#"))
    )
    kinds = {path: slot.kind for path, slot in decoder.slots.items()}
    if f"{_VALUES}[*]" not in kinds or any(kinds.get(path) != "string" for path in (_NAMES, f"{_INTERFACES}[*]")):
        raise DefinitionError(channel.message_type, "its definition in the log lacks names or values of the joints")
    return InterfaceDecoder(decoder)


def _value_decoder(channel: Channel, wanted: tuple[str, ...]) -> ValueDecoder:
    """Return the decoder of Protobuf or JSON; a JSON schema without fields leaves it to the messages what they hold."""
    definitions = definitions_of(channel)
    paths: dict[str, str] = {}
    slots: dict[str, Slot] = {}
    for column in wanted:
        for path in (column, *_OTHER_NAMES.get(column, ())):
            kind = kind_at(definitions, full_name(channel.message_type), steps_of(path)) if definitions else None
            if kind is None and not definitions:
                path, kind = _as_foxglove(column)  # noqa: PLW2901 - no schema has another name for it
            if kind is not None:
                paths[column], slots[column] = path, Slot(kind, len(slots))
                break
    if channel.encoding == "json":
        return ValueDecoder(slots, paths, parse_json)
    descriptors = descriptors_of(channel.definition, channel.message_type)
    parser = ProtobufParser(descriptors, channel.message_type, [steps_of(path) for path in paths.values()])
    return ValueDecoder(slots, paths, parser.parse)


def _as_foxglove(column: str) -> tuple[str, str]:
    """Return the path that Foxglove's schemas have for a column, and the type of the field there."""
    path = _OTHER_NAMES.get(column, (column,))[0]
    kinds = {"frame_id": "string", "name": "string", "sec": "int64", "nsec": "int64"}
    return path, kinds.get(path.rpartition(".")[2], "float64")
