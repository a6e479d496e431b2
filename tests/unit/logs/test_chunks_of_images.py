"""Chunks that are mostly images: small messages are read without what lies behind them, and none is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.summary import Summary
from mcap.writer import CompressionType, IndexType, Writer

from icrtool.logs.containers.open_log import open_log

START_NS = 1_760_000_000_000_000_000
IMAGE_BYTES, CHUNK_BYTES, IMAGES = 300_000, 250_000, 8
COMPRESSIONS = [CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD]


def write(
    path: Path, compression: CompressionType, *, images_first: bool = False, indexes: int = IndexType.ALL
) -> Path:
    """Eight chunks of twenty small messages and an image, which closes the chunk unless it comes first."""
    rng = np.random.default_rng(1)
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=CHUNK_BYTES, compression=compression, index_types=IndexType(indexes))
        writer.start()
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        small, image = (writer.register_channel(topic, "cdr", schema) for topic in ("/small", "/image"))
        for k in range(IMAGES):
            picture = rng.integers(0, 16, IMAGE_BYTES, dtype=np.uint8).tobytes()
            time = START_NS + k * 1_000_000_000
            if images_first:
                writer.add_message(image, time, picture[: CHUNK_BYTES // 2], time)
            for i in range(20):
                writer.add_message(small, time + i, bytes(rng.integers(0, 256, 50, dtype=np.uint8)), time + i)
            writer.add_message(image, time + 20, picture, time + 20)
        writer.finish()
    return path


def small_messages(path: Path) -> tuple[list[tuple[int, bytes]], list[str], int]:
    """Return time and content of the small messages, the problems, and the bytes of all blocks."""
    container = open_log(path)
    try:
        number = next(channel.id for channel in container.channels if channel.topic == "/small")
        found, size = [], 0
        for block in container.blocks(frozenset({number})):
            size += len(block.data)
            for row in np.flatnonzero(block.channel == number):
                content = block.data[block.start[row] : block.end[row]].tobytes()
                found.append((int(block.log_time_ns[row]), content))
        return found, [one.sentence for one in container.problems], size
    finally:
        container.close()


def by_library(path: Path) -> list[tuple[int, bytes]]:
    with path.open("rb") as file:
        return [(message.log_time, message.data) for _, _, message in make_reader(file).iter_messages(["/small"])]


@pytest.mark.parametrize("images_first", [False, True])
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_small_messages_are_those_the_library_reads(
    tmp_path: Path, compression: CompressionType, images_first: bool
) -> None:
    log = write(tmp_path / "log.mcap", compression, images_first=images_first)
    found, problems, _ = small_messages(log)
    assert found == by_library(log)
    assert len(found) == 20 * IMAGES
    assert not problems


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.ZSTD])
def test_images_behind_them_are_not_decompressed(tmp_path: Path, compression: CompressionType) -> None:
    _, _, size = small_messages(write(tmp_path / "log.mcap", compression))
    assert size < 0.6 * IMAGES * IMAGE_BYTES


def test_without_message_index_all_is_read(tmp_path: Path) -> None:
    indexes = IndexType.ALL & ~IndexType.MESSAGE
    log = write(tmp_path / "log.mcap", CompressionType.ZSTD, indexes=indexes)
    found, _, size = small_messages(log)
    assert (len(found), size > IMAGES * IMAGE_BYTES) == (20 * IMAGES, True)


def summary_of(log: Path) -> Summary:
    with log.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    return summary


CHANNEL_AT, OFFSET_AT = 9, 23
"""Where the channel and the first message's offset stand in a record of a message index."""


@pytest.mark.parametrize(("at", "value"), [(CHANNEL_AT, 77), (OFFSET_AT + 3, 99), (OFFSET_AT + 7, 99)])
def test_a_message_index_that_contradicts_its_chunk_is_not_used(tmp_path: Path, at: int, value: int) -> None:
    """Of the small messages: a channel that the file lacks, an offset behind the chunk, a negative one."""
    log = write(tmp_path / "log.mcap", CompressionType.NONE)
    whole, content = by_library(log), bytearray(log.read_bytes())
    summary = summary_of(log)
    chunk = summary.chunk_indexes[2]
    (small,) = (number for number, one in summary.channels.items() if one.topic == "/small")
    record = chunk.message_index_offsets[small]
    content[record + at] = value
    log.write_bytes(content)
    found, problems, _ = small_messages(log)
    assert found == whole
    assert not problems


@pytest.mark.parametrize("damage", ["index", "messages"])
def test_damage_is_found_as_in_any_chunk(tmp_path: Path, damage: str) -> None:
    """A wrong message index, or a damaged record header: the whole chunk is read, and its checksum decides."""
    log = write(tmp_path / "log.mcap", CompressionType.NONE)
    whole, content = by_library(log), bytearray(log.read_bytes())
    chunk = summary_of(log).chunk_indexes[2]
    if damage == "index":
        at = chunk.chunk_start_offset + chunk.chunk_length
        content[at] = 99
    else:
        at = content.index(whole[45][1]) - 31
        content[at] = 77
    log.write_bytes(content)
    found, problems, _ = small_messages(log)
    if damage == "index":
        assert found == whole
    else:
        assert found == whole[:40] + whole[60:]
        assert "checksum" in problems[0]
