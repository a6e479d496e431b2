"""Options for a simulated drive and its sensors, and parsers of their values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields
from typing import Any

import click

from icrtool.cli.options import NOT_NEGATIVE, POSITIVE, Command, add_options

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


def degrees(within: click.FloatRange | None = None) -> Callable[[Any], float]:
    """Return what reads an angle in degrees, of a range where one is given, and gives radians."""

    def radians(text: Any) -> float:  # noqa: ANN401 - what click has: a text, or the default
        return math.radians((within or click.FLOAT).convert(text, None, None))

    return radians


OPTIONS: dict[str, tuple[str, str | None, Any, str]] = {
    "--icrs": ("icrs_m", "YR,YL,X", icrs_text, "True ICRs [m]; default: by the robot's width, or the study's."),
    "--path": ("kind", None, click.Choice(PATHS), "Path to drive; study convergence then has no other."),
    "--duration": ("duration_s", "S", POSITIVE, "Duration of a drive [s]; default: 100, or the study's."),
    "--speed": ("speed_mps", "MPS", POSITIVE, "Speed of the body; on the spot: of the faster track."),
    "--radius": ("radius_m", "M", NOT_NEGATIVE, "Radius of circles and of the tightest bends."),
    "--leg": ("leg_m", "M", POSITIVE, "Length of a lawnmower's legs."),
    "--encoder-counts": ("encoder_counts", "N", POSITIVE, "Counts per wheel turn; default: the robot's, or 8192."),
    "--input-noise": ("input_noise_mps", "MPS", NOT_NEGATIVE, "White noise of each sample of the track speeds."),
    "--input-bias": ("input_bias_mps", "MPS", float, "Bias of both track speeds."),
    "--gnss": ("gnss_std_m", "rtk|waas|METRES", gnss_text, "Noise of north and east: rtk 0.01 m, waas 0.30 m."),
    "--gnss-rate": ("gnss_rate_hz", "HZ", POSITIVE, "Fixes per second."),
}
"""Options of `simulate` and `study`: the field of the plan, path or sensors that each sets, metavar, type, help."""


def drive_options(**defaults: object) -> Callable[[Command], Command]:
    """Add `OPTIONS` and --change to a command; `defaults`: by field, none for the others."""

    def add(command: Command) -> Command:
        text = "The ICRs become these after T seconds; repeatable."
        change = click.option("--change", "changes", metavar="T:YR,YL,X", type=change_text, multiple=True, help=text)
        fields = [
            click.option(
                name, field, metavar=metavar, type=kind, default=defaults.get(field),
                show_default=defaults.get(field) is not None, help=text,
            )
            for name, (field, metavar, kind, text) in OPTIONS.items()
        ]  # fmt: skip
        return add_options(command, *fields, change)

    return add


def given_fields(record: type, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options that set fields of a record, those that were given or have a default."""
    names = (field.name for field in fields(record))
    return {name: given[name] for name in names if given.get(name) not in (None, ())}
