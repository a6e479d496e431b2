"""Excitation: the verdict follows what was driven, and agrees with the scatter of fits."""

from __future__ import annotations

import pytest
from msgspec.structs import astuple

from icrtool.estimation.observability import cut_states, find_excitation
from icrtool.pipeline import fit
from icrtool.records.run import ICR_COLUMNS, Run, track_of
from icrtool.records.run_document import ExcitationDocument
from support.exact_drives import CONFIG, simulate


def excitation_of(run: Run) -> ExcitationDocument:
    return find_excitation(cut_states(run.table, track_of(run), run.track_width_m), {})


@pytest.fixture(scope="module")
def varied():
    return excitation_of(fit(simulate(0, seconds=120.0, offset_deg=0.0, lever=(0.0, 0.0), scales=(1.0, 1.0)), CONFIG))


def test_a_varied_drive_shows_all_and_says_nothing(varied) -> None:
    assert set(astuple(varied.verdict)) == {"shown"}
    assert varied.notes == ()
    assert varied.turned_right_deg > 180.0
    assert varied.turned_left_deg > 180.0
    assert all(0.0 < std < 0.03 for std in astuple(varied.std_m))


def test_a_straight_drive_shows_none_and_asks_for_spins() -> None:
    found = excitation_of(fit(simulate(0, path="straight", seconds=60.0, offset_deg=0.0), CONFIG))
    assert set(astuple(found.verdict)) == {"not shown"}
    assert "two full turns on the spot" in found.notes[-1].text


def test_a_circle_asks_for_the_other_way() -> None:
    found = excitation_of(fit(simulate(0, path="circle", seconds=60.0, offset_deg=0.0), CONFIG))
    assert set(astuple(found.verdict)) != {"shown"}
    assert "to the left" in found.notes[-1].text


def test_more_way_tells_more(varied) -> None:
    longer = excitation_of(fit(simulate(0, seconds=240.0, offset_deg=0.0, lever=(0.0, 0.0), scales=(1.0, 1.0)), CONFIG))
    assert all(longer.std_m[name] < varied.std_m[name] for name in ICR_COLUMNS)
