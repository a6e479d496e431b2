"""What gathers the columns of a channel: by its message type, and by how its messages are serialized."""

from __future__ import annotations

from icrtool.errors import DefinitionError
from icrtool.logs.containers.channel import Channel
from icrtool.logs.messages.decoded_values import MessageDecoder
from icrtool.logs.messages.decoder import ros_decoder
from icrtool.logs.messages.dynamic_joints import DYNAMIC_JOINT_STATE, DynamicJointCollector
from icrtool.logs.messages.nmea import NMEA_SENTENCE, SentenceDecoder
from icrtool.logs.messages.topic_table import HEADER, TopicCollector

READ_ENCODINGS = ("cdr", "ros1")
"""Serializations of messages that are read: of ROS 2 and of ROS 1."""

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
    if channel.message_type == NMEA_SENTENCE:
        return SentenceDecoder(ros_decoder(channel, (*HEADER, "sentence")))
    return ros_decoder(channel, wanted)
