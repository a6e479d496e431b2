"""What gathers the columns of a channel: by its message type, and by how its messages are serialized."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from icrtool.errors import DefinitionError
from icrtool.kernels.arrays import Ints
from icrtool.logs.containers.channel import Block, Channel
from icrtool.logs.messages.decoded_values import (
    NMEA_SENTENCE,
    MessageDecoder,
    SentenceDecoder,
    ValueDecoder,
    parse_json,
)
from icrtool.logs.messages.decoder import Decoder, ros_decoder
from icrtool.logs.messages.definitions import definitions_of, full_name, kind_at
from icrtool.logs.messages.protobuf import ProtobufParser, descriptors_of
from icrtool.logs.messages.schema import BASE, MOST_ELEMENTS, NAME, SEQUENCE, Definitions, Slot, steps_of
from icrtool.logs.messages.topic_table import HEADER, TopicCollector, TopicTable, merge_tables, time_order
from icrtool.records.text import LogText

DYNAMIC_JOINT_STATE = "control_msgs/DynamicJointState"
MOST_JOINTS = 100
MOST_INTERFACES = 32
"""A message with more joints is treated as damaged; of more interfaces per joint only the first ones are read."""

MOST_LAYOUTS = 16
"""Different numbers of joints in the messages of a topic; each takes about 0.1 s. Messages with others are not read."""

_LISTS = "interface_values"
_JOINTS = "number of joints"
_NAMES = "joint_names[*]"


class DynamicJointCollector:
    """Gathers ``name[*]``, ``position[*]`` and ``velocity[*]`` of a topic of DynamicJointState messages."""

    def __init__(self, channel: Channel) -> None:
        self._channel = channel
        self._definitions = definitions_of(channel)
        self._collectors: dict[int, TopicCollector] = {}
        self._tables: list[TopicTable] = []
        self._times: list[Ints] = []
        self._unreadable = 0
        kinds = {path: slot.kind for path, slot in self._collector(1).decoder.slots.items()}
        texts = (_NAMES, "joint 0.interface_names[*]")
        if "joint 0.values[*]" not in kinds or any(kinds.get(path) != "string" for path in texts):
            raise DefinitionError(channel.message_type, "its definition in the log lacks names or values of the joints")
        self._counter = self._decoder(0, (_JOINTS,))

    def feed(self, block: Block, number: int) -> None:
        """Add the messages of a block whose channel is `number`."""
        joints = np.full(len(block.channel), -1)
        for rows, decoded in self._counter.decode(block, number):
            self._times.append(block.log_time_ns[rows])
            joints[rows[decoded.readable]] = decoded.numbers(_JOINTS)
            joints[joints > MOST_JOINTS] = -1
            self._unreadable += int(np.count_nonzero(joints[rows] < 0))
        for count, messages in zip(*np.unique(joints[joints >= 0], return_counts=True), strict=True):
            if int(count) not in self._collectors and len(self._collectors) > MOST_LAYOUTS:
                self._unreadable += int(messages)
                continue
            collector = self._collector(int(count))
            collector.feed(block._replace(channel=joints), int(count))
            # Converted at once: the names of all interfaces of a long log take many times the memory of the result.
            self._tables.append(_as_joint_state(collector.table(), int(count)))

    def table(self) -> TopicTable:
        """Return what was gathered, sorted by log time."""
        topic, message_type = self._channel.topic, self._channel.message_type
        nothing = TopicTable(topic, message_type, np.empty(0, np.int64), {}, {}, self._unreadable)
        merged = merge_tables([nothing, *self._tables])[0]
        return replace(merged, set_back=time_order(np.concatenate(self._times or [nothing.log_time_ns]))[0])

    def _collector(self, joints: int) -> TopicCollector:
        if joints not in self._collectors:
            lists = [f"joint {j}.{what}[*]" for j in range(joints) for what in ("interface_names", "values")]
            self._collectors[joints] = TopicCollector(
                self._channel, self._decoder(joints, (*HEADER, _NAMES, *lists), MOST_INTERFACES)
            )
        return self._collectors[joints]

    def _decoder(self, joints: int, wanted: tuple[str, ...], most: int = MOST_ELEMENTS) -> Decoder:
        if (encoding := self._channel.encoding) not in ("cdr", "ros1"):
            raise DefinitionError(self._channel.topic, f"its lists within lists are not read in {str(encoding)!r}")
        return ros_decoder(self._channel, wanted, self._unrolled(joints), most)

    def _unrolled(self, joints: int) -> Definitions:
        """Return the definitions with the list of lists as a number and so many fields."""
        name = full_name(self._channel.message_type)
        if name not in self._definitions:
            raise DefinitionError(self._channel.message_type, "its definition in the log is another type's")
        constants, fields = self._definitions[name]
        flat: list[tuple[str, tuple[int, Any]]] = []
        for field, (node, detail) in fields:
            if field != _LISTS:
                flat.append((field, (node, detail)))
            elif int(node) != SEQUENCE or int(detail[0][0]) != NAME:
                raise DefinitionError(self._channel.message_type, f"its {_LISTS} is not a list of messages")
            else:
                flat.append((_JOINTS, (BASE, ("uint32", 0))))
                flat += [(f"joint {j}", (NAME, detail[0][1])) for j in range(joints)]
        return {**self._definitions, name: (constants, flat)}


def _as_joint_state(table: TopicTable, joints: int) -> TopicTable:
    """Return the table with the columns of a JointState; NaN where a joint has no such interface."""
    columns = {path: values for path, values in table.columns.items() if path in HEADER}
    texts = {path: texts for path, texts in table.texts.items() if path in HEADER}
    if not len(table):
        return table
    names, texts["name[*]"] = table.words(_NAMES)
    columns["name[*]"] = np.full((len(table), joints), -1, np.int64)
    columns["name[*]"][:, : names.shape[1]] = names[:, :joints]
    for quantity in ("position", "velocity"):
        column = columns[f"{quantity}[*]"] = np.full((len(table), joints), np.nan)
        for j in range(joints):
            column[:, j] = _interface(table, f"joint {j}.", quantity)
    return replace(table, columns=columns, texts=texts)


def _interface(table: TopicTable, joint: str, quantity: str) -> NDArray[np.float64]:
    """Return the values (n,) of the interface with a name, NaN where a message does not list the name."""
    (names, texts), values = table.words(f"{joint}interface_names[*]"), table.column(f"{joint}values[*]")
    column = np.full(len(table), np.nan)
    if quantity not in texts:
        return column
    for place in range(min(names.shape[1], values.shape[1])):
        here = names[:, place] == texts.index(LogText(quantity))
        column[here] = values[here, place]
    return column


READ_ENCODINGS = ("cdr", "ros1", "protobuf", "json")
"""Serializations of messages that are read: of ROS 2, of ROS 1, and those of Foxglove."""

_OTHER_NAMES = {
    "header.stamp.sec": ("timestamp.sec", "timestamp.seconds"),
    "header.stamp.nanosec": ("timestamp.nsec", "timestamp.nanos", "header.stamp.nsec"),
    "header.frame_id": ("frame_id",),
}
"""Fields that stand for those of a ROS header in JSON and in Protobuf."""

Collector = TopicCollector | DynamicJointCollector
"""Gathers the columns of one topic while blocks go by."""


def collector_for(channel: Channel, wanted: tuple[str, ...]) -> Collector:
    """Return what gathers the wanted columns of a channel.

    Raises
    ------
    DefinitionError
        The layout of the channel's type is not known, or its serialization is not read.
    """
    if channel.encoding not in READ_ENCODINGS:
        raise DefinitionError(channel.topic, f"serialization {str(channel.encoding)!r} is not read")
    if channel.message_type == DYNAMIC_JOINT_STATE:
        return DynamicJointCollector(channel)
    return TopicCollector(channel, _decoder_for(channel, wanted))


def _decoder_for(channel: Channel, wanted: tuple[str, ...]) -> MessageDecoder:
    if channel.encoding in ("protobuf", "json"):
        return _value_decoder(channel, wanted)
    if channel.message_type == NMEA_SENTENCE:
        return SentenceDecoder(ros_decoder(channel, (*HEADER, "sentence")))
    return ros_decoder(channel, wanted)


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
