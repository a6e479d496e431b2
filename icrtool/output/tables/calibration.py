"""A calibration as text, and as a file that appears whole or not at all."""

from __future__ import annotations

import json
import math
from pathlib import Path

from icrtool.calibration.findings import CALIBRATION_SCHEMA, Calibration, Finding
from icrtool.errors import OutputError
from icrtool.output.atomic_file import whole_file
from icrtool.output.run_directory import json_bytes

FILE_NAME = "calibration.json"

DIGITS = {"_deg": (2, "°"), "_m": (3, "m"), "_s": (3, "s"), "scale": (4, "")}


def format_calibration(calibration: Calibration) -> str:
    """Return the table of a calibration, no line end."""
    facts = calibration.facts
    right, left = math.degrees(facts.turned_right_rad), math.degrees(facts.turned_left_rad)
    speed = f"{facts.speed_mps:.2f} ± {facts.speed_std_mps:.2f} m/s"
    lines = [
        calibration.name,
        "",
        f"drive       {facts.way_m:.0f} m at {speed}, turned {right:.0f}° right and {left:.0f}° left",
        f"compared    {calibration.windows} windows of way, {calibration.stretches} independent stretches",
        "",
        f"{'parameter':<36}{'value ± std':<24}verdict",
    ]
    for finding in calibration.findings:
        note = f": {finding.note}" if finding.note else ""
        lines.append(f"{finding.label:<36}{value_text(finding):<24}{finding.verdict}{note}")
    lines += ["", *_setting_lines(calibration)]
    return "\n".join(lines)


def value_text(finding: Finding) -> str:
    """Return value and standard deviation with their unit; a dash where there is none."""
    if not math.isfinite(finding.value):
        return "–"
    digits, unit = next(form for ending, form in DIGITS.items() if finding.key.endswith(ending))
    number = f"{finding.value:+.{digits}f}" if not finding.key.endswith("scale") else f"{finding.value:.{digits}f}"
    spread = f" ± {finding.std:.{digits}f}" if finding.verdict != "given" else ""
    return f"{number}{spread} {unit}".rstrip()


def _setting_lines(calibration: Calibration) -> list[str]:
    if not calibration.settings:
        if any(finding.verdict == "shown" for finding in calibration.findings):
            return ["nothing to configure: what the drive showed is what the configuration already says"]
        return ["nothing to configure: the drive showed nothing well enough"]
    lines = ["to configure, as options:"]
    lines.append("  " + " ".join(f"--set {setting.key}={setting.value:g}" for setting in calibration.settings))
    lines.append("or in a file for --config:")
    sections: dict[str, list[str]] = {}
    for setting in calibration.settings:
        section, _, key = setting.key.partition(".")
        why = f"  # {setting.why}" if setting.why else ""
        # a TOML float keeps its point
        sections.setdefault(section, []).append(f"  {key} = {float(f'{setting.value:g}')!r}{why}")
    for section, keys in sections.items():
        lines += [f"  [{section}]", *keys]
    return lines


def write_calibration(calibration: Calibration, place: Path) -> Path:
    """Write calibration.json: into `place` where that is a folder, else as `place`.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    OutputError
        Something that is not a calibration is there, or it cannot be written.
    """
    file = calibration_file(place)
    with whole_file(file) as partial:
        partial.write_bytes(json_bytes(calibration.summary()))
    return file


def calibration_file(place: Path) -> Path:
    """Return where a calibration asked for at `place` goes.

    Raises
    ------
    OutputError
        Its folder does not exist, or something that is not a calibration is there.
    """
    file = place / FILE_NAME if place.is_dir() else place
    if not file.parent.is_dir():
        raise OutputError(file, f"there is no folder {file.parent}", "make it, or name another place")
    if file.exists() and not _is_ours(file):
        raise OutputError(file, "a file that is not a calibration is there", "it is left alone; name another place")
    return file


def _is_ours(file: Path) -> bool:
    try:
        return bool(json.loads(file.read_bytes())["schema"] == CALIBRATION_SCHEMA)
    except (OSError, ValueError, KeyError, TypeError):
        return False
