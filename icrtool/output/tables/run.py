"""A run as blocks: whether it can be used, the numbers, the checks, and the sources of the numbers."""

from __future__ import annotations

import math
import shlex
import textwrap
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from msgspec import UNSET

from icrtool.alignment.corrections import CORRECTION_SIGMAS
from icrtool.estimation.filter_setup import configured_noise
from icrtool.estimation.observability import lacking_turns
from icrtool.output.text_blocks import (
    BRIEF_WIDTH,
    LABEL,
    VERBOSE,
    Block,
    Check,
    Checks,
    Facts,
    Line,
    Section,
    Table,
    Title,
    format_blocks,
)
from icrtool.output.text_format import (
    duration_text,
    error_text,
    jump_count,
    plus_minus,
    position_word,
    role_word,
    run_title,
    topics_text,
)
from icrtool.records.measurements import LONGEST_RESPONSE_S, GroundStretch
from icrtool.records.notes import Note, first_to_read, is_grave
from icrtool.records.run import ICR_COLUMNS, ICR_WORDS, Run, icr_text
from icrtool.records.run_document import ControllerNumbers, RunDocument
from icrtool.records.text import counted, distance_text, shortened

TYPICAL_DELAY_S, SLOW_MPS = 0.1, 0.05
"""Typical delay of receivers [s], to show its effect; speed below which a delay has little effect [m/s]."""

SLIPPING_MULTIPLIER = 1.1
"""Multiplier from which on a robot slips: its wheels show a turn that is larger than its own by this factor."""

SMALLEST_DELAY_S = 0.05
"""Smallest delay that is printed [s]."""

NOTED_SHARE = 0.05
"""Share of rejected fixes from which on they are a reason for care."""

NOTED_SCALE = 0.002
"""Smallest correction of wheel speeds that is printed, as a share."""

SMALLEST_OFFSET_DEG = 0.05
"""Smallest correction of the heading that is printed [deg]."""

NOT_SHOWN_WORDS = {"weak": "weak: found roughly", "not shown": "not shown: cannot be found"}
"""Words after an ICR, by the verdict of `find_excitation`."""

AGREES_SIGMAS = 3.0
"""Difference of two estimates of an ICR, in standard deviations, below which they agree."""

LONGEST_TOPIC = 60
"""Largest number of characters of a stream's topics in a sentence."""

LabelledLine = tuple[str, str]
"""Label of a line, and its sentence."""


def format_run(run: Run) -> str:
    """Return a run as text, at most 100 columns wide, without the last line end.

    Warnings are not in it: they belong to stderr.
    """
    return format_blocks(run_blocks(run.document))


def run_blocks(document: RunDocument) -> list[Block]:
    """Return the output of `icrtool fit` as blocks: usability, numbers, checks, and sources of the numbers."""
    excitation = document.excitation
    turns_text = f"{excitation.turned_right_deg:,.0f}° right, {excitation.turned_left_deg:,.0f}° left"
    driven = f"{distance_text(document.drive.distance_m)}, {duration_text(document.drive.duration_s)}"
    verdict = "" if not document.usable else "PARTLY" if document.partly_because else "USABLE"
    grounds = unstated_grounds(document) if document.usable else ()
    why = "the ground changes: no single multiplier fits the whole drive" if grounds else document.partly_because
    label, blanks = f"{verdict:{LABEL + 2}}", " " * (LABEL + 2)
    lines = textwrap.wrap(
        why or warnings_line(document.notes), BRIEF_WIDTH, initial_indent=label, subsequent_indent=blanks
    )
    roles: dict[str, list[str]] = {}
    for stream in document.streams:
        topics = shortened(topics_text(stream.topic), LONGEST_TOPIC)
        roles.setdefault(topics, []).append("position" if stream.role == "gnss" else stream.role)
    inputs = "; ".join(f"{topic} ({', '.join(taken)})" for topic, taken in roles.items())
    return [
        unusable_line(document),
        Title(run_title(document), f"{driven}, turned {turns_text}"),
        Line("\n".join(lines) or verdict, "good" if document.usable else "as is"),
        Facts(_stretch_rows(grounds)),
        *(number_blocks(document) if document.usable else ()),
        Checks(run_checks(document)),
        Facts([("corrected", "; ".join(corrections(document))), ("inputs", inputs)]),
        streams_section(document),
    ]


def next_blocks(document: RunDocument, place: str, examine: str) -> list[Block]:
    """Return the place of a run, and the next step; `examine` is the command that finds the problem of its log."""
    command = shlex.join(["icrtool", "dropout-report", place]) if document.usable else examine
    if (stretches := unstated_grounds(document)) and document.inputs:
        times = [word for stretch in stretches[1:] for word in ("--terrain-change", f"{stretch.begin_s:.0f}")]
        command = shlex.join(["icrtool", "fit", document.inputs[0].path, *times])
    drive = next_step(document)
    tested = document.usable and not stretches
    distance = "without GNSS: not known yet; the next command tests it" if tested else ""
    facts = Facts([("written to", place), ("distance", distance), ("next", drive)])
    return [Section("", [facts, next_line("" if drive else command)])]


def unstated_grounds(document: RunDocument) -> tuple[GroundStretch, ...]:
    """Return the stretches of a drive whose ground changes, as found; none where the user stated the changes."""
    return () if document.request.changes_s else document.wheels.ground_stretches


def _stretch_rows(stretches: Sequence[GroundStretch]) -> list[LabelledLine]:
    """Return time and multiplier ± σ of stretches, two on a line."""
    rows = [
        f"{stretch.begin_s:.0f} to {stretch.end_s:.0f} s: {stretch.multiplier:.3f}"
        f" ± {max(stretch.multiplier_std, 0.001):.3f}"
        for stretch in stretches
    ]
    return [("" if row else "multiplier", ", ".join(rows[row : row + 2])) for row in range(0, len(rows), 2)]


def next_line(command: str) -> Line:
    """Return the next command on one line, which is not wrapped so that it can be copied; empty without a command."""
    return Line(f"{'next':12}{command}" if command else "", "as is")


def next_step(document: RunDocument) -> str:
    """Return what to check or to drive next, of a run that is not usable; empty where nothing is known to help."""
    if document.usable:
        return ""
    wrong = next((finding.text for finding in document.notes if finding.code == "wheel_scale_differs"), "")
    return wrong.partition(": ")[2] if scale_is_wrong(document) else to_drive(document)


def scale_is_wrong(document: RunDocument) -> bool:
    """Return whether a run must not be used because the wheel radius, or the unit of the wheels, is wrong."""
    return any(finding.code == "wheel_scale_wrong" for finding in document.notes)


def unusable_line(document: RunDocument) -> Line:
    """Return why the ICRs of a run must not be used, by its document; empty where they can be."""
    return Line("" if document.usable else f"Do not use: {document.unusable_because}", "bad")


def warnings_line(notes: Sequence[Note]) -> str:
    """Return the number of warnings, and the finding of the first of the highest grade; empty without warnings."""
    count, first = sum(not is_grave(finding) for finding in notes), first_to_read(notes)
    return f"{counted(count, 'warning')} (-v): {first.finding}" if first is not None else ""


def number_blocks(document: RunDocument, controller_numbers: ControllerNumbers | None = None) -> list[Block]:
    """Return the numbers for a controller, and the ICRs from which they are computed.

    `controller_numbers`: numbers to print instead of the numbers of the run.
    """
    width_m, icrs = document.config.robot.track_width_m, [document.icr_of_drive(column) for column in ICR_COLUMNS]
    numbers = controller_numbers or document.controller
    if width_m is not None and numbers is not None:
        return blocks_of_numbers(numbers, width_m, icrs)
    why = "no multiplier and no no-slip model: robot.track_width_m is not known (--robot, --set)"
    if width_m is not None:
        unknown = [ICR_WORDS[name] for name, icr in zip(ICR_COLUMNS[:2], icrs, strict=False) if icr is None]
        why = f"no multiplier: {' and '.join(unknown) or 'it'} could not be found"
    return [Facts([("controller", why), _icr_row(icrs)])]


def blocks_of_numbers(
    numbers: ControllerNumbers, width_m: float, icrs: Sequence[tuple[float, float] | None]
) -> list[Block]:
    """Return the numbers of a controller with one standard deviation each, and the ICRs."""
    radii = f"{numbers.left_radius:.3f}, {numbers.right_radius:.3f}"
    std = max(numbers.left_radius_std, numbers.right_radius_std)
    multiplier = plus_minus(numbers.multiplier, numbers.multiplier_std, sign="")
    rows = [
        ("wheel_separation_multiplier", f"{multiplier}, next drive ± {numbers.multiplier_next_std:.2g}"),
        ("left, right wheel radius", f"{radii} ± {std:.3f} × configured"),
    ]
    without = f"(right - left) / {width_m:g} m is the multiplier; without slip: ±{width_m / 2:.3g} m"
    return [Facts(rows, "controller"), Facts([_icr_row(icrs), ("", without)])]


def _icr_row(icrs: Sequence[tuple[float, float] | None]) -> LabelledLine:
    """Return the row with the ICRs and their standard deviations; None for an ICR that is not known."""
    named_icrs = zip(ICR_WORDS.values(), icrs, strict=True)
    return "ICRs [m]", ", ".join(
        f"{word.removeprefix('y ')} {icr_text(*(icr or (None, None)))}" for word, icr in named_icrs
    )


def run_checks(document: RunDocument) -> list[Check]:
    """Return the checks of a run, each with its finding and its details."""
    checks = [*_filter_check(document), excitation_check(document)]
    checks += [*_fix_checks(document), *_heading_checks(document), *_delay_checks(document)]
    if spans := document.outages_ns:
        away = duration_text(sum(end - begin for begin, end in spans) / 1e9)
        lost = len(document.rtk_losses_ns)
        cause = (f"{lost} by loss of RTK",) if lost else ()
        checks.append(Check("care", "outages", f"{len(spans)}, {away} in all", cause))
    if events := document.events:
        kinds = ", ".join(f"{count} {kind}" for kind, count in Counter(event.kind for event in events).items())
        worst = max(events, key=lambda event: (event.end_s - event.begin_s) * event.severity)
        lasted = duration_text(worst.end_s - worst.begin_s)
        missed_text = f"{100 * worst.severity:.0f} % of the wheels' motion missed"
        most = f"worst: {worst.kind} from {worst.begin_s:.1f} s for {lasted}, {missed_text}"
        checks.append(Check("care", "slip events", f"{kinds}; left out of the fit", (most,)))
    return checks


def _filter_check(document: RunDocument) -> Iterator[Check]:
    """Yield the filter's final ICRs, and whether they agree with the drive's ICRs where both are known."""
    final, final_std = document.icr.final, document.icr.final_std
    ends, apart = [], []
    for column in ICR_COLUMNS:
        word = ICR_WORDS[column]
        final_value, final_value_std, drive_icr = final[column], final_std[column], document.icr_of_drive(column)
        if drive_icr is None or final_value is None or final_value_std is None:
            continue
        value, std = drive_icr
        ends.append(f"{word.removeprefix('y ')} {final_value:+z.3f}")
        sigmas = abs(final_value - value) / max(math.hypot(std, final_value_std), 1e-9)
        if sigmas > AGREES_SIGMAS:
            apart.append(f"{word} differs by {sigmas:.1f} σ: the end of the drive is not like the whole")
    if ends and unstated_grounds(document):
        yield Check("care", "EKF", f"ends at {', '.join(ends)}: across grounds")
    elif ends:
        text = f"ends at {', '.join(ends)}: {'; '.join(apart) or 'agrees'}"
        yield Check("care" if apart else "good", "EKF", text)


def excitation_check(document: RunDocument) -> Check:
    """Return the check of the information about the ICRs; for an ICR that is not shown, what to drive."""
    excitation, drive = document.excitation, to_drive(document)
    spun = excitation.spun_right_deg + excitation.spun_left_deg
    turns_text = f"turned {excitation.turned_right_deg:,.0f}° right, {excitation.turned_left_deg:,.0f}° left"
    more = (f"{turns_text}, {spun:,.0f}° of it on the spot",)
    if excitation.verdict.all_shown:
        text = f"shown, but {drive}" if drive else "all three ICRs shown: enough turns for each"
        return Check("care" if drive else "good", "excitation", text, more)
    weak = [(excitation.verdict[name], ICR_WORDS[name]) for name in ICR_COLUMNS if excitation.verdict[name] != "shown"]
    words = "; ".join(
        f"{', '.join(name for icr, name in weak if icr == verdict)} {verdict}"
        for verdict in dict.fromkeys(icr_verdict for icr_verdict, _ in weak)
    )
    # The missing information is printed with the ICRs, and what to drive on a further line.
    lacks = drive.rpartition(": ")[2]
    return Check("care", "excitation", f"{words}{f': {lacks}' if lacks else ''}", more)


def _fix_checks(document: RunDocument) -> Iterator[Check]:
    """Yield checks of the positions: number of used positions, distance of the filter from them, and jumps."""
    gnss, word = document.gnss, position_word(document)
    if count := gnss.used + gnss.rejected:
        reasons = {"gate": gnss.rejected_by_gate, **gnss.rejected_by_reason}
        why = ", ".join(f"{reason} {count:,}" for reason, count in reasons.items() if count)
        more = [f"rejected: {why}"] if why else []
        if (difference := gnss.mean_difference_m) is not None and (largest := gnss.max_difference_m) is not None:
            raised = document.filter.process_position_mps != configured_noise(document.config).position_mps
            close = "; follows them closely, because the position noise was raised" if raised else ""
            more.append(f"filter to {word}: mean {error_text(difference)}, max {error_text(largest)}{close}")
        for name, fixes in gnss.classes.items() if len(gnss.classes) > 1 else ():
            done = {"rejected": fixes.rejected, "down-weighted": fixes.down_weighted,
                    "wrongly reported as fixed": fixes.sold_as_fixed}  # fmt: skip
            parts = ", ".join(f"{count:,} {outcome}" for outcome, count in done.items() if count)
            more.append(f"{name} {fixes.fixes:,}{': ' if parts else ''}{parts}")
        if gnss.recoveries:
            times = "once" if gnss.recoveries == 1 else f"{gnss.recoveries:,} times"
            more.append(f"re-acquired after rejection: {times}")
        good = gnss.rejected < NOTED_SHARE * count
        measured = "fixes" if word == "GNSS fixes" else "positions"
        yield Check("good" if good else "care", measured, f"{gnss.rejected:,} of {count:,} rejected", tuple(more))
    if jumps := jump_count(document.reference_jumps):
        yield Check("care", "reference", jumps)


def _heading_checks(document: RunDocument) -> Iterator[Check]:
    """Yield checks of the heading: its difference from the course over ground, and its source."""
    heading = document.heading
    gate = f", {heading.rejected:,} rejected (gate)" if heading.rejected else ""
    more = [f"{heading.source.replace('_', ' ')}: {heading.parts}"] if heading.parts else []
    more.append(f"{heading.used:,} of {heading.used + heading.rejected:,} used{gate}")
    if heading.offset_deg is None:
        why = "could not be compared with the course over ground: too little straight driving"
        yield Check("fact", "heading", why, tuple(more))
        return
    value = f"{plus_minus(heading.offset_deg, heading.offset_std_deg, 1)}°"
    cause = f" ({heading.offset_name})" if heading.offset_name else ""
    applied = heading.applied_offset_deg
    more.insert(0, f"corrected by {-applied:+z.1f}°" if applied else "not corrected")
    yield Check("good", "heading", f"{value} from the course over ground{cause}", tuple(more))


def _delay_checks(document: RunDocument) -> Iterator[Check]:
    """Yield a check for each stream that seems to lag or lead the wheels."""
    if document.filter.reference_delay_s or document.heading.applied_delay_s:
        return
    checks = []
    for word, facts in (("headings", document.heading), ("fixes", document.gnss)):
        delay, std = facts.delay_s, facts.delay_std_s
        if delay is not None and std is not None and abs(delay) > max(SMALLEST_DELAY_S, CORRECTION_SIGMAS * std):
            checks.append(
                f"{word} {'lag' if delay > 0 else 'lead'} the wheels by {plus_minus(abs(delay), std, 2, '')} s"
            )
    multiplier = document.icr.separation_multiplier
    slips = multiplier is None or multiplier > SLIPPING_MULTIPLIER
    cause = "slip of the wheels" if slips else f"the robot's response to its wheels, up to {LONGEST_RESPONSE_S:g} s,"
    lines = [*checks, f"not corrected: {cause} has the same effect"] if checks else []
    speed = document.drive.speed_mean_mps
    if document.gnss.delay_s is None and document.config.frames.reference_delay_s == "auto" and speed > SLOW_MPS:
        shift = error_text(TYPICAL_DELAY_S * speed)
        lines.append(
            f"fixes: this drive does not show their delay; a lag of {TYPICAL_DELAY_S:g} s would move x by {shift}"
        )
    if lines:
        yield Check("fact", "delays", lines[0], tuple(lines[1:]))


def corrections(document: RunDocument) -> list[str]:
    """Return what the alignment corrected, a few words each."""
    applied = {name: finding.applied for name, finding in document.alignment.items()}
    scale, left, right = (applied.get(name) or 1.0 for name in ("wheel_scale", "left_scale", "right_scale"))
    texts = [f"wheels {100 * scale:.1f} %"] if abs(scale - 1.0) > NOTED_SCALE else []
    if abs(left - right) > NOTED_SCALE:
        side, share = ("left", (right - left) / right) if left < right else ("right", (left - right) / left)
        other_side = "right" if side == "left" else "left"
        texts.append(f"{side} wheels {100 * share:.1f} % below {other_side}")
    if abs(offset := document.heading.applied_offset_deg) >= SMALLEST_OFFSET_DEG:
        texts.append(f"heading {-offset:+z.1f}°")
    delays = (("position", document.filter.reference_delay_s), ("heading", document.heading.applied_delay_s))
    texts += [f"{word} {'lag' if delay > 0 else 'lead'} {abs(delay):.2f} s" for word, delay in delays if delay]
    return texts


def to_drive(document: RunDocument) -> str:
    """Return what to drive to find the ICRs that a run does not show; empty if turns would not help.

    Turns do not help if the wheel radius is wrong, because the filter then rejects the measurements.
    """
    excitation = document.excitation
    if scale_is_wrong(document):
        return ""
    if excitation.verdict.all_shown:
        return lacking_turns(*np.radians([excitation.turned_right_deg, excitation.turned_left_deg]).tolist())
    return next((finding.text for finding in excitation.notes if finding.code == "turns_lacking"), "")


def streams_section(document: RunDocument) -> Section:
    """Return the streams that were read, and the estimates of the filter."""
    speed = f"{plus_minus(document.drive.speed_mean_mps, document.drive.speed_std_mps, 2, '')} m/s (mean ± std)"
    streams = []
    for stream in document.streams:
        message_type = stream.message_type.replace("/msg/", "/")
        rate = f"{stream.rate_hz:.1f} Hz" if stream.rate_hz is not None else "unknown"
        names = (role_word(document, stream.role), topics_text(stream.topic), message_type)
        streams.append((*names, rate, f"{stream.count:,}", stream.clock))
    head = ("stream", "topic", "type", "rate", "samples", "clock")
    tables = [Table("lllrrl", streams, head), *_icr_tables(document), *_odometry_table(document)]
    return Section("Streams, filter", [f"The robot drove at {speed}.", *tables], VERBOSE)


def _odometry_table(document: RunDocument) -> Iterator[Table]:
    """Yield the errors of the paths by wheel speeds alone; nothing for a run of an earlier version."""
    names = {"final ICRs": "icr", "momentary ICRs": "icr_momentary", "no slip": "no_slip"}
    errors = {words: getattr(document.odometry, name) for words, name in names.items()}
    rows = [
        (words, *(error_text(error_m) for error_m in (path.mean_error_m, path.max_error_m, path.end_error_m)))
        for words, path in errors.items()
        if path is not None and path is not UNSET and path.mean_error_m is not UNSET
    ]
    if rows:
        yield Table("lrrr", rows, ("wheels alone, whole drive", "mean error", "largest", "at the end"))


def _icr_tables(document: RunDocument) -> Iterator[Table]:
    """Yield the ICRs of the drive, the convergence of the filter's ICRs, and the ICRs between the terrain changes."""
    icr, rows = document.icr, []
    for column in ICR_COLUMNS:
        drive_text = icr_text(*(document.icr_of_drive(column) or (None, None)))
        mean, std, time_s = icr.mean[column], icr.std[column], icr.convergence_s[column]
        if mean is None:
            rows.append((ICR_WORDS[column], drive_text, "", "", "", ""))
            continue
        convergence = f"{time_s:.1f} s" if time_s is not None else "none"
        final = icr_text(icr.final[column], icr.final_std[column])
        verdict = NOT_SHOWN_WORDS.get(document.excitation.verdict[column], "")
        rows.append((ICR_WORDS[column], drive_text, final, convergence, plus_minus(mean, std), verdict))
    yield Table("lrrrrl", rows, ("ICR [m]", "value ± σ", "EKF: final ± σ", "converged in", "mean ± std after that", ""))
    segments = []
    for number, segment in enumerate(document.segments, start=1):
        icrs = [(segment.mean[column], segment.std[column]) for column in ICR_COLUMNS]
        texts = (icr_text(*icr) if icr[0] is not None else "no states" for icr in icrs)
        segments.append((f"  {number}", f"{segment.begin_s:.1f} s", *texts))
    head = ("segment", "begins", *(f"{ICR_WORDS[column]} ± std [m]" for column in ICR_COLUMNS))
    yield Table("lr", segments, head)
    grounds = [
        (
            f"  {number}",
            f"{stretch.begin_s:.0f} s",
            f"{stretch.end_s:.0f} s",
            plus_minus(stretch.multiplier, stretch.multiplier_std),
        )
        for number, stretch in enumerate(document.wheels.ground_stretches, start=1)
    ]
    yield Table("lrrr", grounds, ("ground", "begins", "ends", "multiplier ± σ by the turns"))
