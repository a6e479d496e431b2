"""The rows of a dropout report: the one table of their names, words, order, looks and places.

A row has the same name in files, messages and pages. A new row needs an entry here, the code that computes it, and a
test.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from icrtool.kernels.error_statistics import Spread

Color = Literal["green", "purple", "blue", "orange", "grey", "brown", "pink", "teal", "olive", "slate"]
"""Name of a colour. `icrtool.output.figures.style` has its value on paper, page.css its value on a screen."""

Dash = Literal["solid", "dashed", "dotted", "dashdot"]

TURNED_BY = ("gyro", "heading")
"""Sensors that can replace the turns of the wheels in a row. The name of the row ends with the sensor: ``icr_gyro``."""

REST_OF_DRIVE = "the rest of the drive"
"""Value of `knows`: the row is tested on distance that its parameters were not fitted to."""

WHOLE_DRIVE = "the whole drive, its trials too"
"""Value of `knows`: the parameters of the row were fitted to the drive with its trials."""

PAST = "the drive before each start"
"""Value of `knows`: the parameters of the row were learned before each trial begins."""

INSTALLATION = "sensors corrected by all of the drive"
"""Value of `knows`: conventions, heading offset, delays, scales and sensor noise come from all of the drive."""


FITTED_SPREAD = Spread(shift=0.3, between=0.45, horizon_std=1.0, grounds=0.7)
"""Spread of p95 between drives for rows that turn by the wheels and whose parameters were fitted to the drive."""

GIVEN_SPREAD = Spread(shift=0.0, between=0.45, horizon_std=0.95, grounds=0.55)
"""Spread of p95 between drives for rows that learn during the drive, and for calibrations."""

UNFITTED_SPREAD = Spread(shift=0.0, between=0.15, horizon_std=0.5, grounds=0.2)
"""Spread of p95 between drives for rows with constant parameters, whose error is the slip of the robot."""

TURNED_SPREAD = Spread(shift=0.0, between=0.15, horizon_std=0.75, grounds=0.3)
"""Spread of p95 between drives for rows that turn by a gyro or a measured heading."""

TOPIC_ROW = "topic"
"""Kind of the rows that stand for a topic of the log."""


@dataclass(frozen=True, slots=True)
class Row:
    """One row of a report.

    Attributes
    ----------
    name : name of the row in summary.csv, in limits and in every output
    words : what predicts the motion, in a few words
    knows : the data that the parameters were learned from
    color, dash, width : line of the row in pictures and on pages; most lines have width 1
    shown : the row is in the first table and is drawn on a page at first; other rows need a click or ``-v``
    pictured : the row is drawn in pictures, and its path is computed for single trials
    in_csv : the row has a column in tables with one column for each row of the report: worst.csv, the page of a batch
    on_robot : a user can run the model on a robot; other rows only analyse a log
    compared : the row serves for comparison: a thin line without interval, drawn with every other row in pictures of
        paths
    turned_shown : `shown` of the row with a gyro or heading
    turned_knows : `knows` of the row with a gyro or heading
    spread : spread of the row's p95 between drives of one robot on one kind of ground
    """

    name: str
    words: str
    knows: str
    color: Color = "slate"
    dash: Dash = "solid"
    width: float = 1.0
    shown: bool = False
    pictured: bool = False
    in_csv: bool = False
    on_robot: bool = False
    compared: bool = False
    turned_shown: bool = False
    turned_knows: str = REST_OF_DRIVE
    spread: Spread = GIVEN_SPREAD


REPORT_ROWS: dict[str, Row] = {
    row.name: row
    for row in (
        Row(
            "calibration", "the calibration that was given", "other logs", "teal", "dashdot",
            shown=True, pictured=True, on_robot=True, turned_shown=True, turned_knows="other logs",
        ),
        Row(
            "controller", "multiplier and radius factors alone", REST_OF_DRIVE, "purple", "dashed",
            shown=True, pictured=True, in_csv=True, on_robot=True, spread=FITTED_SPREAD,
        ),
        Row(
            "recommended", "motion model of eight terms", REST_OF_DRIVE, "green", width=1.3,
            shown=True, pictured=True, in_csv=True, on_robot=True, turned_shown=True, spread=FITTED_SPREAD,
        ),
        Row(
            "adaptive", "motion model that adapts", f"other logs, and {PAST}, {INSTALLATION}",
            "pink", "dotted", shown=True, pictured=True, in_csv=True, on_robot=True,
            turned_knows=f"other logs, and {PAST}, {INSTALLATION}",
        ),
        Row(
            "icr", "ICRs as estimated at each start", f"{PAST}, {INSTALLATION}", "blue", "dashed",
            pictured=True, in_csv=True,
            turned_knows=f"{PAST}, {INSTALLATION}",
        ),
        Row("icr_final", "ICRs at the end of the log", WHOLE_DRIVE, "grey", "dotted", turned_knows=WHOLE_DRIVE,
            spread=FITTED_SPREAD),
        Row(
            "vendor", "published skid factor, not fitted", "the published factor", "brown", "dotted", 0.6,
            shown=True, pictured=True, in_csv=True, on_robot=True, compared=True, spread=UNFITTED_SPREAD,
        ),
        Row(
            "no_slip", "track width alone", "the track width", "orange", "dashdot", 0.6,
            shown=True, pictured=True, in_csv=True, on_robot=True, compared=True, spread=UNFITTED_SPREAD,
        ),
        Row(
            TOPIC_ROW, "pose or odometry recorded in the log", "not known: computed on the robot", "olive", "dashed",
            shown=True, pictured=True, on_robot=True,
        ),
    )
}  # fmt: skip
"""The rows by name, in the order in which they are shown. ``calibration:STEM`` is a row of kind ``calibration``,
``topic:/its/name`` a row of kind ``topic``."""

MAIN_ROW, FALLBACK_ROW = "recommended", "icr"
"""Name of the row that represents a log, and of the row that replaces it in a report without held-out rows."""

LONGEST_ROW_NAME = 28
"""Largest length of a row's name in tables and titles [characters]; the middle of a longer name is left out."""

FURTHER_LOOKS: tuple[tuple[Color, Dash], ...] = (
    ("teal", "dashdot"), ("olive", "dashed"), ("slate", "solid"), ("teal", "dotted"), ("olive", "solid"),
    ("slate", "dashdot"), ("teal", "dashed"), ("olive", "dotted"), ("slate", "dotted"),
)  # fmt: skip
"""Colours and dashes of further rows of one kind (calibrations, topics) and of a caller's rows, in turn."""


def turned_by(name: str) -> str:
    """Return the sensor that a row turns by, ``gyro`` or ``heading``; empty where it turns by the wheels alone.

    The row of a topic turns by no sensor, even if the name of the topic ends with a sensor.
    """
    if name.startswith(f"{TOPIC_ROW}:"):
        return ""
    return next((suffix for suffix in TURNED_BY if name.endswith(f"_{suffix}")), "")


def base_of(name: str) -> str:
    """Return the name of a row without the sensor at its end."""
    by = turned_by(name)
    return name.removesuffix(f"_{by}") if by else name


def kind_of(name: str) -> str:
    """Return the name of a row's entry in `REPORT_ROWS`; for a row without entry, its own name without `turned_by`."""
    return base_of(name).partition(":")[0]


def row_of(name: str) -> Row:
    """Return the row of a name: an entry, also with a gyro or heading; a calibration; a topic; a model of a caller."""
    row = replace(REPORT_ROWS.get(kind_of(name)) or Row(name, "given by the caller", "not known"), name=name)
    if not (by := turned_by(name)):
        return row
    return replace(
        row, words=f"{row.words}, with the {by}", knows=row.turned_knows, width=min(row.width, 0.6),
        shown=row.turned_shown, pictured=False, in_csv=False, compared=False, spread=TURNED_SPREAD,
    )  # fmt: skip


def rows_of(names: Iterable[str]) -> dict[str, Row]:
    """Return rows by name in the order in which they are shown; rows of one kind get different colours and dashes."""
    places = {kind: place for place, kind in enumerate(REPORT_ROWS)}
    unique_names = list(dict.fromkeys(names))
    bases = list(dict.fromkeys(map(base_of, unique_names)))

    def place(name: str) -> tuple[int, int, str]:
        return places.get(kind_of(name), len(places)), bases.index(base_of(name)), turned_by(name)

    looks: dict[str, tuple[Color, Dash]] = {}
    rows: dict[str, Row] = {}
    for name in sorted(unique_names, key=place):
        row, base = row_of(name), base_of(name)
        if base not in REPORT_ROWS:
            color, dash = looks.setdefault(base, FURTHER_LOOKS[len(looks) % len(FURTHER_LOOKS)])
            row = replace(row, color=color, dash=dash)
        rows[name] = row
    return rows


def in_order(names: Iterable[str]) -> list[str]:
    """Return names of rows in the order in which they are shown, rows with a gyro after rows without."""
    return list(rows_of(names))


def shown_rows(names: Sequence[str]) -> list[str]:
    """Return the names of the rows that are shown first, in order; with `FALLBACK_ROW` where `MAIN_ROW` is missing."""
    instead = () if MAIN_ROW in names else (FALLBACK_ROW,)
    return [name for name, row in rows_of(names).items() if row.shown or name in instead]


IN_CSV = tuple(name for name, row in REPORT_ROWS.items() if row.in_csv)
"""Names of the rows that have a column where a table has one column a row, in order."""
