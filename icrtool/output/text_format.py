"""Words and numbers in the form of figures and tables."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING

from icrtool.records.acceptance import CHOICE_HORIZON_M
from icrtool.records.samples import ROLE_WORDS, Role
from icrtool.records.text import counted, distance_text

if TYPE_CHECKING:
    from icrtool.motion.models import FittedModel
    from icrtool.records.calibration_document import ControllerErrors
    from icrtool.records.run_document import DriveDocument, ReferenceJumpDocument, RunDocument

_NOT_XML = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")
"""Pattern of the characters that XML 1.0 cannot hold."""

PATH_WORDS = {
    "filter": "filter", "smoothed": "smoother", "icr": "ICR odometry", "icr_momentary": "momentary-ICR odometry",
    "no_slip": "no-slip odometry",
}  # fmt: skip
"""Words for the paths of a run."""

GLOSSARY = {
    "ICR": "Instantaneous centre of rotation of a track: the point of the ground, seen from the robot, about which it "
    "turns. A robot that slips turns about points further out than its tracks.",
    "trial": "From one recorded state, drive on with wheel speeds alone. The error is the distance to the reference "
    "at the end.",
    "95 %, expected": "19 of 20 trials end nearer than the first; the second is the mean over all trials.",
    "σ": "One standard deviation.",
}
"""Meanings of the words on a run's page. The words for rows are in `icrtool.records.rows`."""

MOST_LINES = 50
"""Largest number of jumps of the reference that are printed; jumps of decided cause come first, then larger ones."""


def run_title(document: RunDocument) -> str:
    """Return the log's name, and the robot's where it has one, from a run's `document`."""
    log, robot = document.log, document.config.robot.name
    return f"{log}  ({robot})" if robot else str(log)


def position_word(document: RunDocument) -> str:
    """Return the words for the position measurements: ``GNSS fixes``, or ``position reference`` for metric poses."""
    return "GNSS fixes" if document.gnss.datum is not None else "position reference"


def fix_word(document: RunDocument) -> str:
    """Return the word for the missing stream of an outage: ``GNSS``, or ``position`` for a metric reference."""
    return "GNSS" if document.gnss.datum is not None else "position"


def direction_words(document: RunDocument | None) -> tuple[str, str]:
    """Return the names of the axes across and up a map: ``East``, ``North``; of a frame without datum ``x``, ``y``."""
    return ("East", "North") if document is None or document.gnss.datum is not None else ("x", "y")


def role_word(document: RunDocument, role: Role) -> str:
    """Return the word for the stream of a role; ``position`` for a metric reference, which is not called GNSS."""
    return ROLE_WORDS[role] if document.gnss.datum is None else role


def topics_text(topics: str) -> str:
    """Return the topics of a stream, each once."""
    return " + ".join(dict.fromkeys(topics.split(" + ")))


def jump_lines(jumps: Sequence[ReferenceJumpDocument]) -> list[str]:
    """Return a line for each jump of the reference: time, size, reason, and effect on trials."""
    listed = sorted(jumps, key=lambda jump: (jump.undecided, -jump.size_m))[:MOST_LINES]
    lines = [
        f"reference jump from {jump.begin_s:.1f} to {jump.end_s:.1f} s: {_jump_size(jump)}: {jump.why}; "
        f"{'trials cross it' if jump.undecided else 'no trial crosses it'}"
        for jump in sorted(listed, key=lambda jump: jump.begin_ns)
    ]
    return [*lines, f"and {len(jumps) - len(lines):,} more in run.json"] if len(jumps) > len(lines) else lines


def _jump_size(jump: ReferenceJumpDocument) -> str:
    turn_text = f"{abs(jump.turn_deg):.0f}°"
    return turn_text if jump.kind == "heading" else f"{error_text(jump.size_m)} and {turn_text}"


def jump_count(jumps: Sequence[ReferenceJumpDocument]) -> str:
    """Return the number of jumps as ``2 jumps of the reference, up to 3.1 m``; empty without jumps."""
    decided = [jump for jump in jumps if not jump.undecided]
    undecided = f"{counted(len(jumps) - len(decided), 'step')} of undecided cause" if len(jumps) > len(decided) else ""
    if not decided:
        return undecided
    largest = max(decided, key=lambda jump: (jump.kind == "position", jump.size_m, abs(jump.turn_deg)))
    text = f"{counted(len(decided), 'jump')} of the reference, up to {_jump_size(largest)}"
    return f"{text}; {undecided}" if undecided else text


def xml_text(text: str) -> str:
    """Return text without the characters that XML 1.0 cannot hold; the rest is escaped by the writer."""
    return _NOT_XML.sub("?", text)


def signed_text(value: float, digits: int = 3) -> str:
    """Return a number with its sign, by default to the millimetre, with a typographic minus instead of a hyphen."""
    return f"{value:+.{digits}f}".replace("-", "−") if round(value, digits) else f"{0:.{digits}f}"


def plus_minus(value: float | None, std: float | None, digits: int = 3, sign: str = "+") -> str:
    """Return a value with its standard deviation, as ``+0.716 ± 0.018``; alone without one, and ``–`` for no value."""
    if value is None:
        return "–"
    text = f"{value:{sign}z.{digits}f}"
    return text if std is None else f"{text} ± {std:.{digits}f}"


def duration_text(seconds: float) -> str:
    """Return a duration as ``12.3 s``, ``14:59 min`` or ``3:07:40 h``."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    whole_s = round(seconds)
    if whole_s < 3600:
        return f"{whole_s // 60}:{whole_s % 60:02d} min"
    return f"{whole_s // 3600}:{whole_s // 60 % 60:02d}:{whole_s % 60:02d} h"


def driven_text(drive: DriveDocument) -> str:
    """Return distance and duration of a drive, as ``398.5 m in 14:59 min``; `drive` of a run's document."""
    return f"{distance_text(drive.distance_m)} in {duration_text(drive.duration_s)}"


def model_text(fitted_model: FittedModel) -> str:
    """Return a fitted model as ``three ICRs (3 parameters, model icr)``."""
    model, count = fitted_model.model, len(fitted_model.parameters)
    return f"{model.label} ({counted(count, 'parameter')}, model {model.name})"


def controller_error_text(errors: ControllerErrors | None) -> str:
    """Return the held-out error of a controller and of the row `recommended`; empty where it was not measured."""
    if errors is None or errors.p95_m is None or errors.full_p95_m is None:
        return ""
    return (
        f"with these numbers alone the error after {CHOICE_HORIZON_M:g} m is {error_text(errors.p95_m)} (95 %, held "
        f"out of the fit), with recommended {error_text(errors.full_p95_m)}"
    )


def turn_text(degrees: float) -> str:
    """Return a turn as ``62° right``; ``0°`` for a turn below half a degree."""
    size = f"{abs(degrees):.0f}°"
    return size if size == "0°" else f"{size} {'right' if degrees >= 0 else 'left'}"


def error_text(metres: float | None) -> str:
    """Return an error [m] with 4 decimals below 0.01 m, 3 below 1 m, and 2 above: ``0.0034 m``, ``3.45 m``."""
    if metres is None or not math.isfinite(metres):
        return "-"
    return f"{metres:.{4 if metres < 0.01 else 3 if metres < 1 else 2}f} m"
