"""What the alignment of one log shows of its sensors, as text."""

from __future__ import annotations

import math

from icrtool.calibration.one_log import LogCalibration, Parameter

DIGITS = {"_deg": (2, "°"), "_m": (3, "m"), "_s": (3, "s"), "scale": (4, "")}


def format_calibration(calibration: LogCalibration) -> str:
    """Return the table of a calibration, no line end."""
    facts = calibration.facts
    right, left = math.degrees(facts.turned_right_rad), math.degrees(facts.turned_left_rad)
    speed = f"{facts.speed_mps:.2f} ± {facts.speed_std_mps:.2f} m/s"
    lines = [
        calibration.name,
        "",
        f"drive       {facts.distance_m:.0f} m at {speed}, turned {right:.0f}° right and {left:.0f}° left",
        f"compared    {calibration.windows} windows of driven distance, {calibration.stretches} independent stretches",
        "",
        f"{'parameter':<36}{'value ± std':<24}verdict",
    ]
    for one in calibration.parameters:
        note = f": {one.note}" if one.note else ""
        lines.append(f"{one.label:<36}{value_text(one):<24}{one.verdict}{note}")
    lines += ["", *_setting_lines(calibration)]
    return "\n".join(lines)


def value_text(one: Parameter) -> str:
    """Return value and standard deviation with their unit; a dash where there is none."""
    if not math.isfinite(one.value):
        return "–"
    digits, unit = next(form for ending, form in DIGITS.items() if one.key.endswith(ending))
    number = f"{one.value:+.{digits}f}" if not one.key.endswith("scale") else f"{one.value:.{digits}f}"
    spread = f" ± {one.std:.{digits}f}" if one.verdict != "given" else ""
    return f"{number}{spread} {unit}".rstrip()


def _setting_lines(calibration: LogCalibration) -> list[str]:
    if not calibration.settings:
        if any(one.verdict == "shown" for one in calibration.parameters):
            return ["nothing to configure: the drive confirms the configuration"]
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
