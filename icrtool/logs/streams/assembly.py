"""The chosen sources as a log: samples in the frames of `icrtool`, by one clock, with what a user must know of them."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError, DataError
from icrtool.kernels.arrays import Floats, Ints
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.topic_table import TopicTable
from icrtool.logs.streams.headings import GYRO_TYPE, find_gyro, find_gyros
from icrtool.logs.streams.select import Candidates, Choice, choose_streams, ignored_joints, other_references
from icrtool.logs.streams.sources import Convention, HeadingSource, Pair, PositionSource, Source, Unit, WheelMotion
from icrtool.logs.streams.stamps import StampedRows, clock_notes, common_clock, increasing, usable_rows
from icrtool.logs.streams.transforms import antenna_place
from icrtool.logs.streams.wheel_pairs import topic_of_side
from icrtool.records.samples import (
    NO_HEADINGS,
    Datum,
    HeadingSamples,
    InputFile,
    OtherReceiver,
    PositionFixes,
    Role,
    Samples,
    StreamChoice,
    WheelSamples,
    rate_and_jitter,
)
from icrtool.records.tables import RobotLog
from icrtool.records.text import LogText

Clock = Literal["header", "log"]


@dataclass(frozen=True, slots=True)
class Survey:
    """A log after one pass: its channels, all candidates, the messages that could not be read, its files.

    Attributes
    ----------
    tables : of their columns those that candidates do not hold: stamps, turn rates, static transforms
    transfer : how much came over a connection, in words; empty for a file on disk
    """

    name: LogText
    path: str
    channels: tuple[Channel, ...]
    tables: tuple[TopicTable, ...]
    candidates: Candidates
    problems: tuple[str, ...]
    inputs: tuple[InputFile, ...]
    transfer: str = ""


def assemble(survey: Survey, config: Config) -> RobotLog:
    """Return the log with its streams chosen and converted; errors as `read_log`."""
    choice = choose_streams(survey.candidates, config, survey.path, survey.channels)
    log = _assemble(survey, config, choice)
    others = []
    for other in other_references(survey.candidates, choice, config):
        # one that cannot be used is no alternative
        with contextlib.suppress(DataError):
            others.append(_assemble(survey, config, other))
    return replace(log, other_references=tuple(others)) if others else log


def _assemble(survey: Survey, config: Config, choice: Choice) -> RobotLog:
    """Return the log with the streams of a choice, converted."""
    found, name = survey.candidates, survey.name
    motion, position, source = choice.wheels, choice.gnss, choice.heading
    chosen: dict[Role, Source] = {"wheels": motion, "gnss": position}
    if source is not None:
        chosen["heading"] = source
    clock = common_clock([one.stamps for one in chosen.values()])
    warnings = list(survey.problems)
    if clock == "log":
        warnings.append(
            f"{name}: one stream has no header stamps, and the header stamps of another are far from log time; "
            "log time is used for all streams"
        )
    warnings += clock_notes([(role, one.stamps) for role, one in chosen.items()], name)
    gnss, datum = _fixes(position, config, clock, name)
    heading, convention = (NO_HEADINGS, "") if source is None else _headings(source, config, clock, name)
    wheels, wheel_warnings = wheel_samples(motion, motion.stamps.on(clock), config, name)
    warnings += wheel_warnings
    warnings += [f"{name}: {ignored}" for ignored in ignored_joints(motion, config)]
    warnings += [f"{name}: {one.topic}: {one.note}" for one in chosen.values() if one.note]
    if source is None:
        warnings += [f"{name}: {one.topic} gives no heading: {one.problem}" for one in found.heading]
    unreadable: dict[str, int] = {table.topic: table.unreadable for table in survey.tables if table.unreadable}
    warnings += [
        f"{name}: {topic}: {unreadable[topic]} messages do not fit their message type; left out"
        for topic in dict.fromkeys(topic_of_side(side) for one in chosen.values() for side in one.topic.split(" + "))
        if topic in unreadable
    ]
    antenna = antenna_place(survey.tables, position.topic)
    place = "" if antenna is None else f"antenna {antenna[0]:+.2f} m forward, {antenna[1]:+.2f} m right of the base"
    samples: dict[Role, Samples] = {"wheels": wheels, "gnss": gnss, "heading": heading}
    details: dict[Role, str] = {
        "wheels": "; position" if wheels.from_position else "; speed",
        "gnss": f"; {place} (/tf_static)" if place else "",
        "heading": f"; {convention}",
    }
    stamps: dict[str, StampedRows] = {one.topic: one.stamps for one in found.heading if one.message_type == GYRO_TYPE}
    log = RobotLog(
        name, wheels, gnss, heading, datum,
        tuple(
            _stream(role, one, samples[role].stamp_ns, clock, one.why + details[role])
            for role, one in chosen.items()
        ),
        survey.inputs, dict(position.rejected), tuple(warnings), antenna,
        find_gyro(survey.tables, motion.topic, "" if source is None else source.topic, clock, stamps),
        find_gyros(survey.tables, clock, stamps),
        _other_receivers(found, position, datum, config, clock, name),
    )  # fmt: skip
    return longest_part(log)


def _other_receivers(
    found: Candidates, chosen: PositionSource, datum: Datum | None, config: Config, clock: Clock, name: str
) -> tuple[OtherReceiver, ...]:
    """Return the fixes of the other GNSS receivers, in the local plane of the chosen one."""
    if datum is None:
        return ()
    return tuple(
        OtherReceiver(source.topic, _fixes(source, config, clock, name, datum)[0])
        for source in found.gnss
        if source.topic != chosen.topic and source.geodetic is not None and source.usable.any() and not source.problem
    )


def _stream(role: Role, source: Source, stamps: Ints, clock: Clock, why: str) -> StreamChoice:
    rate, jitter = rate_and_jitter(stamps)
    used: Clock = clock if source.stamps.header_ns is not None else "log"
    return StreamChoice(role, source.topic, source.message_type, len(stamps), rate, used, jitter, why)


def _fixes(
    source: PositionSource, config: Config, clock: Clock, name: str, given: Datum | None = None
) -> tuple[PositionFixes, Datum | None]:
    """Return positions in the local plane about the datum: `given`, else the configured one, else the first fix."""
    if source.is_empty:
        raise DataError(name, f"{source.topic}: {source.problem}", "name another position in topics.gnss")
    stamps = source.stamps.on(clock)
    rows = np.flatnonzero(source.usable)
    rows = rows[np.argsort(stamps[rows], kind="stable")]
    datum = given
    if source.geodetic is not None:
        from pymap3d import geodetic2ned

        latitude, longitude, height = source.geodetic[rows].T
        if datum is None:
            first = float(latitude[0]), float(longitude[0])
            datum = Datum(*(config.frames.datum or first), float(height[0]))
        north, east, _ = geodetic2ned(
            latitude, longitude, height, datum.latitude_deg, datum.longitude_deg, datum.height_m
        )
    else:
        north, east = np.asarray(source.metric, np.float64)[rows].T
    north, east, var_north, var_east, covariance = (
        np.ascontiguousarray(one, np.float64) for one in (north, east, *source.variance[rows].T)
    )
    stated = None if source.stated_class is None else source.stated_class[rows]
    return PositionFixes(stamps[rows], north, east, var_north, var_east, covariance, stated), datum


def _headings(source: HeadingSource, config: Config, clock: Clock, name: str) -> tuple[HeadingSamples, str]:
    """Return headings clockwise from north, and a text on how the convention is known."""
    if source.is_empty:
        why = source.problem or "no usable heading"
        raise DataError(name, f"{source.topic}: {why}", "choose another with topics.heading")
    convention: Convention = source.convention
    why = source.convention_why
    if config.frames.heading != "auto":
        convention, why = config.frames.heading, "configured"
    stamps = source.stamps.on(clock)
    rows = usable_rows(stamps, source.usable)
    samples = HeadingSamples(stamps[rows], source.heading_rad(convention)[rows], source.variance[rows])
    return samples, f"{convention.upper()} ({why})"


MOST_NOT_FINITE = 0.01
"""A larger share of wheel samples without a number is reported."""


def wheel_samples(motion: WheelMotion, stamps: Ints, config: Config, log_name: str) -> tuple[WheelSamples, list[str]]:
    """Return wheel speeds held over each interval, in the unit of the log, and warnings.

    Returns
    -------
    samples, warnings

    Raises
    ------
    ConfigError
        A body twist whose track width is not configured, or a configured quantity that the topic does not have.
    DataError
        Fewer than two usable samples.
    """
    rows, backwards, dropped = increasing(stamps)
    warnings = []
    if backwards:
        warnings.append(f"{log_name}: {motion.topic}: {backwards} wheel stamps go back; sorted")
    if dropped > len(stamps) // 100:
        warnings.append(
            f"{log_name}: {motion.topic}: {dropped} of {len(stamps)} wheel samples share a stamp with another; "
            "the last was kept"
        )
    left, right, unit, is_position = _pick(motion, config)
    left, right = left[rows], right[rows]
    finite = np.isfinite(left) & np.isfinite(right)
    lost = len(finite) - int(np.count_nonzero(finite))
    if lost > len(finite) * MOST_NOT_FINITE:
        warnings.append(
            f"{log_name}: {motion.topic}: {lost} of {len(finite)} wheel samples are not finite numbers; left out"
        )
    stamps, left, right = stamps[rows][finite], left[finite], right[finite]
    if len(stamps) < 2:
        raise DataError(log_name, f"{motion.topic} holds {len(stamps)} usable wheel samples", "at least two are needed")
    if is_position:
        interval = np.diff(stamps) / 1e9
        with np.errstate(over="ignore"):
            left, right = (np.append(np.diff(side) / interval, 0.0) for side in (left, right))
        left[-1], right[-1] = left[-2], right[-2]
    warnings += [f"{log_name}: {note}" for note in _assumptions(motion, config)]
    return WheelSamples(stamps, left, right, unit, is_position), warnings


def _pick(motion: WheelMotion, config: Config) -> tuple[Floats, Floats, Unit, bool]:
    """Return left, right, their unit, and whether they are positions."""
    if motion.twist is not None:
        given = config.wheels.twist_width_m
        width = given if given is not None else config.robot.track_width_m
        if width is None:
            raise ConfigError(
                "robot.track_width_m",
                f"needed to convert the body twist of {motion.topic} to wheel speeds",
                "give it, or --robot NAME",
            )
        speed, turn = motion.twist.T
        with np.errstate(over="ignore", invalid="ignore"):
            return speed - turn * width / 2, speed + turn * width / 2, "m", False
    wanted = config.wheels.quantity
    positions, speeds = motion.position, motion.speed
    by_position = positions is not None and wanted != "velocity" and (wanted != "auto" or _alive(positions, speeds))
    if wanted in ("position", "counts") and positions is None:
        raise ConfigError("wheels.quantity", f"{motion.topic} has no {wanted}", "leave it on auto")
    if speeds is not None and not by_position:
        return *speeds, motion.unit, False
    if positions is None or wanted == "velocity":
        raise ConfigError("wheels.quantity", f"{motion.topic} has no velocity of both sides", "leave it on auto")
    unit: Unit = "counts" if wanted == "counts" else motion.unit
    return *positions, unit, True


def _assumptions(motion: WheelMotion, config: Config) -> list[str]:
    """Return a warning with the width assumed for a body twist, and the option that sets it."""
    if motion.twist is None or config.wheels.twist_width_m is not None:
        return []
    undone = f"converted to wheel speeds with {config.robot.track_width_m:g} m (robot.track_width_m)"
    advice = "if its controller multiplies the wheel separation, set wheels.twist_width_m to the product"
    return [f"{motion.topic} holds a body twist: {undone}; {advice}, else the estimated ICRs are too close together"]


def _alive(positions: Pair, speeds: Pair | None) -> bool:
    """Return whether the positions change where the speeds do: some drivers leave the position at zero."""
    finite = np.isfinite(positions[0]) & np.isfinite(positions[1])
    if np.count_nonzero(finite) < len(finite) / 2:
        return False
    if speeds is None:
        return True
    still = [float(np.ptp(side[finite])) == 0.0 for side in positions]
    moves = [float(np.nanmax(np.abs(side))) > 0.0 for side in speeds]
    return not any(s and m for s, m in zip(still, moves, strict=True))


PAUSE_S, LONGEST_PAUSE_S = 600.0, 86_400.0
"""A longer interval between samples is reported; a log whose samples are a day apart is of two recordings."""


def longest_part(log: RobotLog) -> RobotLog:
    """Return a log without what another clock stamped, and with warnings where its clock may have been set forward.

    Of parts that are `LONGEST_PAUSE_S` and more apart, that with the most wheel samples, and positions, is kept.
    """
    stamps, fixes = log.wheels.stamp_ns, log.gnss.stamp_ns
    ends = np.append(np.flatnonzero(np.diff(stamps) > LONGEST_PAUSE_S * 1e9), len(stamps) - 1)
    begins = np.append(0, ends[:-1] + 1)
    positions = np.searchsorted(fixes, stamps[ends], side="right") - np.searchsorted(fixes, stamps[begins])
    longest = int(np.argmax((ends - begins) * (positions > 1)))
    parts: dict[str, Any] = {}
    for role, margin_s in (("wheels", 0.0), ("gnss", LONGEST_PAUSE_S), ("heading", LONGEST_PAUSE_S)):
        margin_ns = int(margin_s * 1e9)
        first, last = stamps[begins[longest]] - margin_ns, stamps[ends[longest]] + margin_ns
        parts[role] = _between(getattr(log, role), first, last)
    counts = {role: (len(kept.stamp_ns), len(getattr(log, role).stamp_ns)) for role, kept in parts.items()}
    warnings = list(log.warnings)
    if lost := [f"{every - kept} of {every} ({role})" for role, (kept, every) in counts.items() if kept < every]:
        warnings.append(
            f"{log.name}: more than a day apart from the other samples, and left out: {', '.join(lost)}; if the clock "
            "was set, --from and --to read that part"
        )
    for role, kept in parts.items():
        longest_s = np.diff(kept.stamp_ns).max(initial=0) / 1e9
        if longest_s > PAUSE_S:
            why = "the recording was paused, or its clock was set forward"
            warnings.append(f"{log.name}: {role}: no samples for {longest_s:.0f} s: {why}")
            break
    return replace(log, warnings=tuple(warnings), **parts)


def _between(samples: Samples, begin_ns: int, end_ns: int) -> Samples:
    """Return the samples with stamps in [begin_ns, end_ns]."""
    inside = (samples.stamp_ns >= begin_ns) & (samples.stamp_ns <= end_ns)
    return samples if inside.all() else samples.cut(inside)
