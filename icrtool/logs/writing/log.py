"""Write a robot log from columns; used by `icrtool simulate`, the sample logs and the tests."""

from __future__ import annotations

import os
import sqlite3
import tempfile
from pathlib import Path

from icrtool.errors import OutputError
from icrtool.logs.writing.containers import write_bag, write_db3, write_mcap
from icrtool.logs.writing.messages import load_typestore, serialise_topics
from icrtool.logs.writing.records import Compression, Container, WheelMessages, WriteOptions
from icrtool.records.sensor_columns import SensorColumns
from icrtool.records.unfinished import unfinished

__all__ = ["Compression", "Container", "SensorColumns", "WheelMessages", "WriteOptions", "write_log"]


def write_log(path: str | Path, columns: SensorColumns, options: WriteOptions) -> Path:
    """Write `columns` as the log a robot would have recorded, in ROS conventions (REP-103, or REP-145 NED).

    Parameters
    ----------
    path : the file to make (``mcap``, ``bag``), or the directory (``db3``); it must not exist
    columns : sensor columns in the frames of `icrtool`
    options : container, message types and conventions

    Returns
    -------
    `path`

    Raises
    ------
    OutputError
        `path` exists or cannot be written. No incomplete file stays: the log is written next to it under another name,
        and renamed when it is complete.

    Notes
    -----
    Log time is the stamp. Topics: ``/imu/data``, ``/gps/fix``, and by `options.wheels` ``/joint_states``,
    ``/wheel_controller/odom``, ``/wheel_controller/twist``, ``/feedback``, ``/left_drive/velocity`` with
    ``/right_drive/velocity``, or ``/lwheel_ticks`` with ``/rwheel_ticks``.
    """
    path = Path(path)
    if os.path.lexists(path):
        raise OutputError(path, "exists already", "remove it or choose another name")
    store = load_typestore(ros1=options.container == "bag")
    topics = serialise_topics(columns, options, store)
    try:
        with (
            tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as scratch,
            unfinished(Path(scratch)),
        ):
            partial = Path(scratch) / path.name
            if options.container == "mcap":
                write_mcap(partial, topics, store, compression=options.compression, definitions=options.definitions)
            elif options.container == "bag":
                write_bag(partial, topics, store, compression=options.compression)
            else:
                write_db3(partial, topics, store, compression=options.compression, definitions=options.definitions)
            partial.rename(path)
    except (OSError, sqlite3.Error) as err:
        reason = err.strerror if isinstance(err, OSError) and err.strerror else str(err)
        raise OutputError(path, "cannot be written", reason) from err
    return path
