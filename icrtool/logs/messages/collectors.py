"""What gathers the columns of a channel: by its message type, and by how its messages are serialized."""

from __future__ import annotations

from icrtool.errors import DefinitionError
from icrtool.logs.containers.channel import Channel
from icrtool.logs.messages.decoded_values import MessageDecoder, ValueDecoder
from icrtool.logs.messages.decoder import ros_decoder
from icrtool.logs.messages.definitions import definitions_of, full_name, kind_at
from icrtool.logs.messages.dynamic_joints import DYNAMIC_JOINT_STATE, DynamicJointCollector
from icrtool.logs.messages.json_messages import parse_json
from icrtool.logs.messages.nmea import NMEA_SENTENCE, SentenceDecoder
from icrtool.logs.messages.protobuf import ProtobufParser, descriptors_of
from icrtool.logs.messages.schema import Slot, steps_of
from icrtool.logs.messages.topic_table import HEADER, TopicCollector

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
