"""From a path to an opened container, by content, not by name."""

from __future__ import annotations

from pathlib import Path

from icrtool.errors import LogError
from icrtool.logio.bag_directory import BagDirectory
from icrtool.logio.channel import Container
from icrtool.logio.mcap_file import McapFile, is_mcap
from icrtool.logio.ros1_bag import Ros1Bag, is_ros1_bag
from icrtool.logio.sqlite_bag import SqliteBag, is_sqlite

KINDS = "an .mcap file, a ROS 1 .bag, a ROS 2 bag directory or a .db3 file"


def open_log(path: Path) -> Container:
    """Open a log.

    Raises
    ------
    LogError
        No such path, an empty file, or none of the containers.
    """
    try:
        if path.is_dir():
            return BagDirectory(path)
        with path.open("rb") as stream:
            if not stream.read(1):
                raise LogError(path, "an empty file", "the recording never began, or the copy failed")
            for is_kind, container in ((is_mcap, McapFile), (is_ros1_bag, Ros1Bag), (is_sqlite, SqliteBag)):
                stream.seek(0)
                if is_kind(stream):
                    return container(path)
    except FileNotFoundError as err:
        raise LogError(path, "no such file or directory") from err
    except OSError as err:
        raise LogError(path, "cannot be read", err.strerror or str(err)) from err
    raise LogError(path, "not a log", f"a log is {KINDS}")
