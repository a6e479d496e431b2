"""What the heading at the start of a trial costs: errors with start headings aligned to the reference's motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from msgspec import UNSET

from icrtool.dropout_analysis.dropout_report import dropout_report
from icrtool.motion.recording import ALIGNED_OVER_M, trial_errors
from icrtool.output.tables.dropout import format_dropout
from icrtool.records.dropout_document import StartHeading
from icrtool.records.run import Run
from support.recordings import THREE_ICRS, make_recording

ROUNDING_M = 1e-9

HORIZONS_M = [5.0, 10.0]


@pytest.fixture(scope="module")
def run(make_run: Callable[..., Run]) -> Run:
    return make_run(duration_s=200.0)


@pytest.fixture(scope="module")
def misled(run: Run) -> Run:
    """The same drive, with headings that are off by 10 degrees, to one side and the other in turn."""
    off = np.radians(10.0) * np.sign(np.sin(run.table.t_s / 7.0))
    return replace(run, table=run.table.changed(heading_rad=run.table.heading_rad + off))


def start_heading(run: Run) -> tuple[StartHeading, str]:
    """Return what the report states about the heading at the start, and all that it prints."""
    report = dropout_report(run, horizons_m=HORIZONS_M)
    best = report.document.best
    assert best is not None
    assert best.start_heading is not UNSET
    assert best.start_heading.p95_m >= best.start_heading.expected_m
    return best.start_heading, format_dropout(report)


def test_aligned_errors_are_those_of_the_path_turned_by_hand() -> None:
    recording = make_recording(THREE_ICRS, THREE_ICRS.prior_mean, seconds=40.0)
    track = recording.track
    place = 1.05 * (track.north + 1j * track.east) * np.exp(0.2j)
    start = np.flatnonzero(track.distance < 2.0)[::50]
    end = np.searchsorted(track.distance, track.distance[start] + 6.0)
    found = trial_errors(
        recording, start, end, lambda t: (np.interp(t, track.t, track.heading), np.interp(t, track.t, place))
    )
    reference = track.north + 1j * track.east
    for one, (s, e) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        a = int(np.searchsorted(track.distance, track.distance[s] + ALIGNED_OVER_M))
        by = (reference[a] - reference[s]) / (place[a] - place[s])
        turned = (place[e] - place[s]) * by / abs(by)
        assert abs(found.aligned[one] - abs(turned - (reference[e] - reference[s]))) < ROUNDING_M
    assert np.median(found.position) > 2.0 * np.median(found.aligned)


def test_trials_too_short_to_align_have_no_aligned_error() -> None:
    recording = make_recording(THREE_ICRS, THREE_ICRS.prior_mean, seconds=40.0)
    track = recording.track
    place = track.north + 1j * track.east
    start = np.arange(0, 100, 10)
    end = np.searchsorted(track.distance, track.distance[start] + 1.5 * ALIGNED_OVER_M)
    found = trial_errors(
        recording, start, end, lambda t: (np.interp(t, track.t, track.heading), np.interp(t, track.t, place))
    )
    assert np.isnan(found.aligned).all()
    assert np.isfinite(found.position).all()


def test_headings_that_are_off_make_most_of_the_error_and_the_answer_says_so(run: Run, misled: Run) -> None:
    (good, text_of_good), (bad, text_of_bad) = start_heading(run), start_heading(misled)
    assert not good.dominates
    assert bad.dominates
    assert bad.p95_m == pytest.approx(10.0 * np.sin(np.radians(10.0)), rel=0.3)
    assert bad.aligned_p95_m < 0.35 * bad.p95_m
    text = " ".join(text_of_bad.split())
    assert "the heading at the start causes most of the error" in text
    assert "or drive straight for some metres before GNSS is lost" in text
    assert "causes most of the error" not in text_of_good
