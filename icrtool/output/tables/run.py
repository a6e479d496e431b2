"""A run as text: the few lines a field engineer reads first."""

from __future__ import annotations

from icrtool.alignment.corrections import SIGNIFICANT_SIGMAS
from icrtool.estimation.filter_setup import configured_noise
from icrtool.output.text_blocks import LABEL, TEXT_WIDTH, Block, Line, Table, Text, labelled
from icrtool.output.text_format import (
    controller_text,
    driven_text,
    duration_text,
    error_text,
    event_kinds,
    excitation_text,
    filter_agreement,
    jump_count,
    position_word,
    role_word,
    run_title,
    topics_text,
    unusable_lines,
)
from icrtool.records.measurements import RESPONSE_S
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS, Run, icr_text
from icrtool.records.run_document import ClassDocument
from icrtool.records.text import counted

TYPICAL_DELAY_S, SLOW_MPS = 0.1, 0.05
"""A delay that receivers have, to show what it does; at lower speeds than this it does little."""

SLIPPING_MULTIPLIER = 1.1
"""A robot that turns by less than its wheels show by this factor slips."""

SMALLEST_DELAY_S = 0.05
"""A delay below this is not worth a line."""


SHOWN_WORDS = {"weak": "weak: found roughly", "not shown": "not shown: cannot be found"}
"""What is printed beside an ICR, by the verdict of `find_excitation`."""

Row = tuple[str, str]
"""What a line is about, and its sentence."""


def format_run(run: Run) -> Text:
    """Return the table of a run: streams, drive, ICRs, position, heading; at most 100 columns wide, no line end.

    Warnings are not in it: they belong to stderr.
    """
    drive = run.document.drive
    speed = f"{drive.speed_mean_mps:.2f} ± {drive.speed_std_mps:.2f} m/s (mean ± std)"
    learned = [*_controller_rows(run), *_filter_rows(run), excitation_row(run)]
    measured = [*_position_rows(run), *_heading_rows(run), *_delay_rows(run), *event_rows(run)]
    return Text(
        [
            *unusable_lines(run.document),
            Line(run_title(run.document), "title"),
            "",
            _stream_table(run),
            "",
            *labelled([("drive", f"{driven_text(drive)}, {speed}")]),
            "",
            _icr_table(run),
            *labelled(learned),
            *_terrain_table(run),
            "",
            *labelled(measured),
        ]
    )


def excitation_row(run: Run) -> Row:
    """Return what the drive could show of the ICRs; advice is among the warnings."""
    return "excitation", excitation_text(run.document.excitation)


def _stream_table(run: Run) -> Table:
    head = ("stream".ljust(LABEL), "topic", "type", "rate", "samples", "clock")
    rows = []
    for stream in run.document.streams:
        type_name = stream.message_type.replace("/msg/", "/")
        hz = stream.rate_hz
        rate, count = f"{hz:.1f} Hz" if hz is not None else "unknown", f"{stream.count:,}"
        rows.append(
            (role_word(run.document, stream.role), topics_text(stream.topic), type_name, rate, count, stream.clock)
        )
    widths = [max(len(row[column]) for row in (head, *rows)) for column in range(6)]
    # Long names are cut: the topic keeps its end, the type its begin.
    space = TEXT_WIDTH - sum(widths[column] for column in (0, 3, 4, 5)) - 2 * 5
    topic = min(widths[1], max(space - widths[2], space // 2))
    kind = min(widths[2], space - topic)
    return Table("lllrrl", [(row[0], _tail(row[1], topic), _head(row[2], kind), *row[3:]) for row in rows], head)


def _icr_table(run: Run) -> Table:
    """Return the ICRs of the drive, and how those of the filter converged."""
    icr, verdicts = run.document.icr, run.document.excitation.verdict
    rows = []
    for column in ICR_COLUMNS:
        found = icr_text(*(run.document.icr_of_drive(column) or (None, None)))
        mean, std, time_s = icr.mean[column], icr.std[column], icr.convergence_s[column]
        if mean is None:
            rows.append((ICR_WORDS[column], found, "", "", ""))
            continue
        convergence = f"{time_s:.1f} s" if time_s is not None else "none"
        verdict = SHOWN_WORDS.get(verdicts[column], "")
        rows.append((ICR_WORDS[column], found, convergence, f"{mean:+.3f} ± {std:.3f}", verdict))
    head = ("ICR [m]".ljust(LABEL), "value ± σ", "EKF: converged in", "mean ± std after that", "")
    return Table("l", rows, head)


def _controller_rows(run: Run) -> list[Row]:
    """Return what a controller is given; it belongs to the ICRs in the table above."""
    numbers, width = run.document.controller, run.track_width_m
    if width is None:
        return [("controller", "left out, and no-slip odometry too: robot.track_width_m is not known")]
    if numbers is None:
        return [("controller", "no multiplier: y right and y left are not shown")] if run.usable else []
    verdicts = run.document.excitation.verdict
    shown = all(verdicts[column] == "shown" for column in ("y_icr_right_m", "y_icr_left_m"))
    note = "" if shown else "; y right and y left are not shown well enough to use it"
    return [("controller", f"{controller_text(numbers)}; (y right - y left) / b, b = {width:g} m{note}")]


def _filter_rows(run: Run) -> list[Row]:
    """Return where the filter's ICRs ended, as a check of those in the table."""
    agreement = filter_agreement(run.document)
    return [("EKF", agreement)] if agreement else []


def _terrain_table(run: Run) -> list[Block]:
    """Return the ICRs between the terrain changes."""
    rows = []
    for number, segment in enumerate(run.document.segments, start=1):
        mean, std = segment.mean, segment.std
        icrs = (f"{mean[c]:+.3f} ± {std[c]:.3f}" if mean[c] is not None else "no states" for c in ICR_COLUMNS)
        rows.append((f"  {number}", f"{segment.begin_s:.1f} s", *icrs))
    head = ("segment".ljust(LABEL), "begins", *(f"{ICR_WORDS[column]} ± std [m]" for column in ICR_COLUMNS))
    return ["", Table("lrl", rows, head)] if rows else []


def _position_rows(run: Run) -> list[Row]:
    gnss = run.document.gnss
    word = position_word(run.document)
    lines = []
    if (difference := gnss.mean_difference_m) is not None and (largest := gnss.max_difference_m) is not None:
        mean, most = error_text(difference), error_text(largest)
        raised = run.process_position_mps != configured_noise(run.config).position_mps
        why = "; follows them closely, because the position noise was raised" if raised else ""
        lines.append(("position", f"filter to {word}: mean {mean}, max {most}{why}"))
    reasons = {"gate": gnss.rejected_by_gate, **gnss.rejected_by_reason}
    why = ", ".join(f"{reason} {count:,}" for reason, count in reasons.items() if count)
    lines.append(
        (
            "fixes" if lines else "position",
            f"{gnss.used:,} used, {gnss.rejected:,} rejected{f' ({why})' if why else ''}",
        )
    )
    lines += _class_rows(gnss.classes, jump_count(run.document.reference_jumps))
    if gnss.recoveries:
        times = "once" if gnss.recoveries == 1 else f"{gnss.recoveries:,} times"
        lines.append(("", f"re-acquired after rejection: {times}"))
    if outages := len(run.outages_ns):
        away = duration_text(float((run.outages_ns[:, 1] - run.outages_ns[:, 0]).sum()) / 1e9)
        lost = len(run.document.rtk_losses_ns)
        cause = f" ({lost} by loss of RTK)" if lost else ""
        lines.append(("", f"{counted(outages, 'outage')}{cause}, {away} in all"))
    return lines


def _class_rows(classes: dict[str, ClassDocument], jumps: str) -> list[Row]:
    """Return what classes the fixes were of, where they were not all of one, and what was done to them."""
    lines = []
    for name, one in classes.items() if len(classes) > 1 else ():
        done = [f"{one.rejected:,} rejected"] if one.rejected else []
        done += [f"{one.down_weighted:,} down-weighted"] if one.down_weighted else []
        done += [f"{one.sold_as_fixed:,} wrongly reported as fixed"] if one.sold_as_fixed else []
        lines.append(("", f"{name} {one.fixes:,}{': ' if done else ''}{', '.join(done)}"))
    if jumps:
        lines.append(("", jumps))
    return lines


def _heading_rows(run: Run) -> list[Row]:
    heading = run.document.heading
    lines = [f"{heading.source.replace('_', ' ')}: {heading.parts}"] if heading.parts else []
    if heading.offset_deg is not None:
        # Adding zero takes the sign off a rounded -0.0.
        value = f"{round(heading.offset_deg, 1) + 0.0:+.1f} ± {heading.offset_std_deg:.1f} deg"
        offset = f"{value} from the course over ground"
        if heading.offset_name:
            offset += f" ({heading.offset_name})"
        applied = heading.applied_offset_deg
        lines.append(f"{offset}; corrected by {0.0 - applied:+.1f} deg" if applied else f"{offset}; not corrected")
    elif not lines:
        lines = ["could not be compared with the course over ground: too little straight driving"]
    used, rejected = heading.used, heading.rejected
    counts = f"{used:,} used, {rejected:,} rejected{f' (gate {rejected:,})' if rejected else ''}"
    return [*(("" if number else "heading", line) for number, line in enumerate(lines)), ("headings", counts)]


def _delay_rows(run: Run) -> list[Row]:
    """Return which streams seem to lag or lead the wheels."""
    if run.document.filter.reference_delay_s or run.document.heading.applied_delay_s:
        return []
    found = []
    for word, facts in (("headings", run.document.heading), ("fixes", run.document.gnss)):
        delay, std = facts.delay_s, facts.delay_std_s
        if delay is not None and std is not None and abs(delay) > max(SMALLEST_DELAY_S, SIGNIFICANT_SIGMAS * std):
            found.append(f"{word} {'lag' if delay > 0 else 'lead'} the wheels by {abs(delay):.2f} ± {std:.2f} s")
    multiplier = run.document.icr.separation_multiplier
    slips = multiplier is None or multiplier > SLIPPING_MULTIPLIER
    cause = "slip of the wheels" if slips else f"the robot's response to its wheels, up to {RESPONSE_S:g} s,"
    lines = [*found, f"not corrected: {cause} has the same effect"] if found else []
    speed = run.document.drive.speed_mean_mps
    if run.document.gnss.delay_s is None and run.config.frames.reference_delay_s == "auto" and speed > SLOW_MPS:
        shift = error_text(TYPICAL_DELAY_S * speed)
        lines.append(f"of the fixes: not shown by this drive; a lag of {TYPICAL_DELAY_S:g} s would move x by {shift}")
    return [("" if number else "delays", line) for number, line in enumerate(lines)]


def event_rows(run: Run) -> list[Row]:
    """Return how many slip events of each kind there were, and the worst: the one that missed most distance."""
    events = run.document.events
    if not events:
        return []
    worst = max(events, key=lambda event: (event.end_s - event.begin_s) * event.severity)
    lasted = duration_text(worst.end_s - worst.begin_s)
    missed = f"{100 * worst.severity:.0f} % of the wheels' motion missed"
    worst_text = f"worst: {worst.kind} from {worst.begin_s:.1f} s for {lasted}, {missed}"
    return [("slip", f"{event_kinds(events)}; the ICRs are not learned there"), ("", worst_text)]


def _tail(text: str, width: int) -> str:
    return text if len(text) <= width else "..." + text[len(text) - width + 3 :]


def _head(text: str, width: int) -> str:
    return text if len(text) <= width else text[: width - 3] + "..."
