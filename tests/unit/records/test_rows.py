"""The table of report rows: order, names with a gyro, calibrations, topics, and the rows shown first."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from icrtool.output.figures.style import COLORS, DASHES, row_pens
from icrtool.records.rows import IN_CSV, REPORT_ROWS, in_order, row_of, rows_of, shown_rows, turned_by

CSS = (Path(__file__).parents[3] / "icrtool" / "output" / "page" / "static" / "page.css").read_text(encoding="utf-8")
NAMES = ["icr", "no_slip", "icr_final", "controller", "recommended", "recommended_gyro", "controller_gyro"]


def test_rows_stand_in_one_order_with_the_gyro_behind_the_wheels():
    names = [*NAMES, "calibration:b", "calibration:a", "calibration:b_gyro", "topic:/odom", "vendor"]
    assert in_order(names) == [
        "calibration:b", "calibration:b_gyro", "calibration:a", "controller", "controller_gyro", "recommended",
        "recommended_gyro", "icr", "icr_final", "vendor", "no_slip", "topic:/odom",
    ]  # fmt: skip
    assert in_order(["mine", "icr_final"]) == ["icr_final", "mine"]


def test_first_stand_rows_that_a_robot_can_run_and_the_filters_where_nothing_is_held_out():
    assert shown_rows(NAMES) == ["controller", "recommended", "recommended_gyro", "no_slip"]
    assert shown_rows(["icr", "no_slip", "icr_final"]) == ["icr", "no_slip"]
    assert all(row.on_robot for row in REPORT_ROWS.values() if row.shown)


@pytest.mark.parametrize(("name", "by"), [("icr_gyro", "gyro"), ("recommended_heading", "heading"), ("icr_final", "")])
def test_a_row_with_a_gyro_is_its_row_drawn_thin_and_says_what_it_turns_by(name: str, by: str):
    assert turned_by(name) == by
    row, plain = row_of(name), row_of(name.removesuffix(f"_{by}"))
    assert (row.color, row.dash) == (plain.color, plain.dash)
    assert row.words.endswith(f"with the {by}") == bool(by)
    assert (row.pictured, row.in_csv) == ((False, False) if by else (plain.pictured, plain.in_csv))


def test_only_what_a_row_states_of_itself_is_learned_from_the_drive_that_it_is_tested_on():
    assert row_of("recommended_gyro").knows == "the rest of the drive"
    assert "whole drive" not in row_of("icr_gyro").knows
    assert "whole drive" in row_of("icr_final").knows
    assert "whole drive" not in row_of("icr").knows
    assert row_of("calibration:may").knows == "other logs"
    assert row_of("mine").knows == "not known"


def test_rows_of_one_kind_are_told_apart_by_their_lines():
    names = ["calibration:a", "calibration:a_gyro", "calibration:b", "calibration:c", "topic:/odom", "mine"]
    rows = rows_of(names)
    looks = {(row.color, row.dash) for name, row in rows.items() if not turned_by(name)}
    assert len(looks) == 5
    assert (rows["calibration:a"].color, rows["calibration:a"].dash) == (
        rows["calibration:a_gyro"].color, rows["calibration:a_gyro"].dash
    )  # fmt: skip
    own = {(row.color, row.dash) for row in REPORT_ROWS.values()}
    assert len(own) == len(REPORT_ROWS)


def test_every_colour_of_a_row_is_known_on_paper_and_on_pages_in_light_and_dark():
    for row in REPORT_ROWS.values():
        assert row.color in COLORS
        assert row.dash in DASHES
        assert len(re.findall(rf"--{row.color}: #[0-9a-f]{{6}};", CSS)) == 2
    assert row_pens(["no_slip", "recommended"])["no_slip"]["linewidth"] < 1.0


def test_tables_with_a_column_a_row_have_those_of_the_robot_first():
    assert IN_CSV == ("controller", "recommended", "adaptive", "icr", "vendor", "no_slip")
