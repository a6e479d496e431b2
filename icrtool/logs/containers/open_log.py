"""Open a log: the container is recognised by its content, not by its file name."""

from __future__ import annotations

import stat
from pathlib import Path
from typing import BinaryIO

from icrtool.errors import LogError
from icrtool.logs.containers.bag_directory import BagDirectory
from icrtool.logs.containers.channel import Container
from icrtool.logs.containers.mcap_file import McapFile, is_mcap
from icrtool.logs.containers.ros1_bag import Ros1Bag, is_ros1_bag
from icrtool.logs.containers.split_files import split_files
from icrtool.logs.containers.sqlite_bag import SqliteBag, is_sqlite
from icrtool.records.regular_file import NOT_REGULAR, SAVE_IT, is_special

MOST_CHANNELS = 2048
"""Topics of a log, each publisher of a ROS 1 bag by itself, that are looked at: some 0.5 ms of time each."""

KINDS = "an .mcap file, a ROS 1 .bag, a ROS 2 bag directory or a .db3 file"


def open_log(path: Path) -> Container:
    """Return the opened container at a path.

    Raises
    ------
    LogError
        The path does not exist, the file is empty, is not a known container, or nothing in it can be read.
    """
    try:
        container = _open(path)
    except FileNotFoundError as err:
        raise LogError(path, "no such file or directory") from err
    except OSError as err:
        raise LogError(path, "cannot be read", err.strerror or str(err)) from err
    if (count := len(container.channels)) > MOST_CHANNELS:
        kept = sorted(container.channels, key=lambda channel: -(channel.count or 0))[:MOST_CHANNELS]
        container.channels = sorted(kept, key=lambda channel: channel.id)
        problems = container.own_problems if isinstance(container, BagDirectory) else container.problems
        problems.add(f"{count:,} topics and publishers: the {MOST_CHANNELS:,} of most messages are used")
    if container.problems and not container.channels:
        container.close()
        raise LogError(path, "nothing in it can be read", container.problems[0])
    return container


def _open(path: Path) -> BagDirectory | McapFile | Ros1Bag | SqliteBag:
    if files := split_files(path):
        return BagDirectory(path, files)
    if stat.S_ISDIR(path.stat().st_mode):
        return BagDirectory(path)
    if is_special(path):
        # Opening a pipe would block, and every container needs random access.
        raise LogError(path, NOT_REGULAR, SAVE_IT)
    with path.open("rb") as stream:
        if not stream.read(1):
            raise LogError(path, "an empty file", "the recording never began, or the copy failed")
        if (container := container_of(stream)) is not None:
            return container(path)
    raise LogError(path, "not a log", f"a log is {KINDS}")


def container_of(stream: BinaryIO) -> type[McapFile | Ros1Bag | SqliteBag] | None:
    """Return which container the first bytes of a file are of; None where it is no log."""
    for is_kind, container in ((is_mcap, McapFile), (is_ros1_bag, Ros1Bag), (is_sqlite, SqliteBag)):
        stream.seek(0)
        if is_kind(stream):
            return container
    return None
