"""Options for a simulated drive and its sensors: paths, parsers of values, and --change."""

from __future__ import annotations

import math
from collections.abc import Iterable

import click

PATHS = ("circle", "curved", "lawnmower", "figure-eight", "spins", "straight")
GNSS_NOISE_M = {"rtk": 0.01, "waas": 0.30}
"""Pentzer 2014, Sections 4 and 6.5."""


def numbers(text: str, form: str, count: int | None = None) -> tuple[float, ...]:
    """Read numbers separated by commas; `form` is what they shall look like."""
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != (count or len(found)) or not found or not all(map(math.isfinite, found)):
        raise click.BadParameter(f"{text!r} is not of the form {form}")
    return found


def icrs_text(text: str) -> tuple[float, ...]:
    """Read ``YR,YL,X``."""
    return numbers(text, "YR,YL,X", 3)


def change_text(text: str) -> tuple[float, tuple[float, ...]]:
    """Read ``T:YR,YL,X``."""
    time, _, icrs = text.partition(":")
    return numbers(time, "T:YR,YL,X", 1)[0], numbers(icrs, "T:YR,YL,X", 3)


def span_text(text: str) -> tuple[float, ...]:
    """Read ``BEGIN:END``."""
    span = numbers(text.replace(":", ",", 1) if ":" in text else "", "BEGIN:END", 2)
    if span[1] <= span[0]:
        raise click.BadParameter(f"{text!r} ends before it begins")
    return span


def place_text(text: str) -> tuple[float, ...]:
    """Read ``FORWARD,RIGHT``."""
    return numbers(text, "FORWARD,RIGHT", 2)


def gnss_text(text: str) -> float:
    """Read ``rtk``, ``waas`` or metres."""
    if text in GNSS_NOISE_M:
        return GNSS_NOISE_M[text]
    metres = numbers(text, "rtk, waas or METRES", 1)[0]
    if metres < 0:
        raise click.BadParameter(f"{text!r} is a negative noise")
    return metres


def check_changes(changes: Iterable[tuple[float, object]], duration_s: float) -> None:
    """Refuse a change of the ICRs that a drive is too short for."""
    unreached = next((time for time, _ in changes if time >= duration_s), None)
    if unreached is not None:
        why = f"no change at {unreached:g} s: the drive lasts {duration_s:g} s"
        raise click.BadParameter(why, param_hint="--change")


CHANGE = click.option(
    "--change",
    "changes",
    metavar="T:YR,YL,X",
    type=change_text,
    multiple=True,
    help="The ICRs become these after T seconds; repeatable.",
)
