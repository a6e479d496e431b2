"""The driven distance of a log with gaps in the wheel data, against the true path."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import icrtool
from icrtool.config import parse_config
from icrtool.kernels.arrays import Bools, Ints
from icrtool.records.run import Run
from support.sparse_drives import START_NS, TrueDrive, drive

GAPS_S = ((60.0, 74.0), (110.0, 130.0))
SHARE = 0.02
"""Largest error of the distance: noise of the fixes shortens and lengthens chords of 0.1 m."""


def outside(stamp_ns: Ints) -> Bools:
    """Return which stamps lie outside the gaps."""
    t = (stamp_ns - START_NS) / 1e9
    return np.asarray(~np.any([(t > begin) & (t < end) for begin, end in GAPS_S], axis=0))


def fitted(made: TrueDrive, *, fixes_too: bool) -> Run:
    log = replace(made.log, wheels=made.log.wheels.cut(outside(made.log.wheels.stamp_ns)))
    if fixes_too:
        log = replace(log, gnss=log.gnss.cut(outside(log.gnss.stamp_ns)))
    return icrtool.fit(log, parse_config({"robot": {"track_width_m": made.width_m}}))


@pytest.mark.parametrize(("path", "seed"), [("lawnmower", 1), ("curved", 2), ("free", 3)])
def test_fixes_in_a_gap_of_the_wheels_give_the_distance(path: str, seed: int) -> None:
    made = drive(path, 0.2, seed, seconds=180.0)
    run = fitted(made, fixes_too=False)
    begin, end = (
        np.searchsorted(made.log.wheels.stamp_ns, stamp) for stamp in (run.table.stamp_ns[0], run.table.stamp_ns[-1])
    )
    true_m = float(np.abs(np.diff(made.place_m[begin : end + 1])).sum())
    assert run.summary["drive"]["distance_m"] == pytest.approx(true_m, rel=SHARE)
    assert "distance_is_lower_limit" not in {one.code for one in run.document.notes}


def test_a_distance_without_fixes_in_a_gap_is_named_a_lower_limit() -> None:
    made = drive("curved", 0.2, 2, seconds=180.0)
    run = fitted(made, fixes_too=True)
    assert run.summary["drive"]["distance_m"] < float(np.abs(np.diff(made.place_m)).sum())
    assert "distance_is_lower_limit" in {one.code for one in run.document.notes}
