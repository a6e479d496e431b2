"""The alignment findings of one log as text."""

from __future__ import annotations

import math

from icrtool.calibration.findings import Calibration, Parameter

DIGITS = {"_deg": (2, "°"), "_m": (3, "m"), "_s": (3, "s"), "scale": (4, "")}


def format_calibration(calibration: Calibration) -> str:
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
    for finding in calibration.findings:
        note = f": {finding.note}" if finding.note else ""
        lines.append(f"{finding.label:<36}{value_text(finding):<24}{finding.verdict}{note}")
    lines += ["", *_setting_lines(calibration)]
    return "\n".join(lines)


def value_text(finding: Parameter) -> str:
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
