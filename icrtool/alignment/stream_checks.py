"""Whether the streams of a log can be used together at all."""

from __future__ import annotations

import numpy as np

from icrtool.errors import DataError
from icrtool.records.tables import RobotLog

IMPOSSIBLE_MPS = 1e6
"""A wheel speed from here on is a broken value: its distance is more than can be cut into windows."""

IMPOSSIBLE_M = 1e9
"""A position this far from the origin is a broken value: metric coordinates of any country are below 1e8 m."""


def check_streams(log: RobotLog) -> None:
    """Refuse streams that cannot be used together.

    Raises
    ------
    DataError
        Fewer than two samples of a stream, none at the same time, stamps that go back, or a value that is not a finite
        number. Logs that were read hold no such rows (`icrtool.read_log` sorts, and leaves out), tables made by a
        program may.
    """
    needed = {"wheel": log.wheels.stamp_ns, "position": log.gnss.stamp_ns, "heading": log.heading.stamp_ns}
    if not len(log.heading.stamp_ns):
        raise DataError(log.name, "no orientation in it", "use preset field, which estimates the heading")
    for what, stamps in needed.items():
        if len(stamps) < 2:
            raise DataError(log.name, f"{len(stamps)} usable {what} samples", "a run needs at least two of each stream")
        back = np.diff(stamps) < 0
        if back.any():
            raise DataError(
                log.name, f"the {what} stamps go back at row {int(back.argmax()) + 1}", "sort the rows by stamp"
            )
    columns = {
        "wheel": (log.wheels.v_left_mps, log.wheels.v_right_mps),
        "position": (log.gnss.north_m, log.gnss.east_m),
        "heading": (log.heading.heading_rad,),
    }
    for what, values in columns.items():
        bad = ~np.logical_and.reduce(np.isfinite(values))
        if bad.any():
            raise DataError(
                log.name,
                f"{np.count_nonzero(bad)} {what} samples are not finite numbers, the first at row {int(bad.argmax())}",
                "leave those rows out",
            )
    variances = {"position": (log.gnss.var_north_m2, log.gnss.var_east_m2), "heading": (log.heading.var_rad2,)}
    for what, stated in variances.items():
        negative = np.logical_or.reduce([variance < 0 for variance in stated])
        if negative.any():
            why = f"a {what} variance is negative, the first at row {int(negative.argmax())}"
            raise DataError(log.name, why, "NaN stands for unknown")
    fastest = float(np.abs(columns["wheel"]).max())
    if fastest >= IMPOSSIBLE_MPS:
        raise DataError(log.name, f"a wheel speed of {fastest:.2g} m/s", "leave out what no wheel can do")
    farthest = float(np.abs(columns["position"]).max())
    if farthest >= IMPOSSIBLE_M:
        raise DataError(log.name, f"a position {farthest:.2g} m from the origin", "is it in its unit?")
    begin = max(int(stamps[0]) for stamps in needed.values())
    end = min(int(stamps[-1]) for stamps in needed.values())
    if begin >= end:
        spans = ", ".join(f"{what} {int(s[0]) / 1e9:.1f}-{int(s[-1]) / 1e9:.1f} s" for what, s in needed.items())
        raise DataError(log.name, "wheels, position and heading do not overlap in time", spans)
