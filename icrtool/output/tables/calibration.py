"""What the alignment of one log shows of its sensors, as text."""

from __future__ import annotations

import math
import textwrap

from icrtool.calibration.one_log import LogCalibration, Parameter
from icrtool.output.text_blocks import VERBOSE, Block, Facts, Line, Section, Table

MEANINGS = "shown: found well enough to set; weak: found roughly; not shown, not separable: this drive cannot find it"

OPTIONS_WIDTH = 76
"""Characters of options in a line of a terminal of 80 columns, beside indent and backslash."""

DIGITS = {"_deg": (2, "°"), "_m": (3, "m"), "_s": (3, "s"), "scale": (4, "")}


def sensor_blocks(calibration: LogCalibration) -> list[Block]:
    """Return the settings that one log proposes, and the estimates that they come from."""
    facts = calibration.facts
    right, left = facts.turned_right_deg, facts.turned_left_deg
    speed = f"{facts.speed_mean_mps:.2f} ± {facts.speed_std_mps:.2f} m/s"
    compared = f"{calibration.windows} windows of driven distance, {calibration.stretches} independent stretches"
    head = [
        ("drive", f"{facts.distance_m:.0f} m at {speed}, turned {right:.0f}° right and {left:.0f}° left"),
        ("compared", compared),
    ]
    rows = [
        (one.label, value_text(one), one.verdict + (f": {one.note}" if one.note else ""))
        for one in calibration.parameters
    ]
    table = Table("l", rows, ("parameter", "value ± std", "verdict"))
    return [Section(calibration.name, [Facts(head), table, MEANINGS, ""], VERBOSE), *setting_blocks(calibration)]


def value_text(one: Parameter) -> str:
    """Return value and standard deviation with their unit; a dash where there is none."""
    if not math.isfinite(one.value):
        return "–"
    digits, unit = next(form for ending, form in DIGITS.items() if one.key.endswith(ending))
    number = f"{one.value:+.{digits}f}" if not one.key.endswith("scale") else f"{one.value:.{digits}f}"
    spread = f" ± {one.std:.{digits}f}" if one.verdict != "given" else ""
    return f"{number}{spread} {unit}".rstrip()


def setting_blocks(calibration: LogCalibration) -> list[Block]:
    """Return the settings that one log proposes."""
    if not calibration.settings:
        shown = any(one.verdict == "shown" for one in calibration.parameters)
        why = "the drive confirms the configuration" if shown else "the drive showed nothing well enough"
        return [f"nothing to configure: {why}"]
    # an option and its value stay together
    options = " ".join(f"--set\u00a0{setting.key}={setting.value:g}" for setting in calibration.settings)
    lines = textwrap.wrap(options, OPTIONS_WIDTH, break_long_words=False, break_on_hyphens=False)
    # a shell joins the lines again
    joined = " \\\n  ".join(lines).replace("\u00a0", " ")
    return [Line(f"to configure:\n  {joined}", "as is")]
