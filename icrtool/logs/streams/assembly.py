"""The chosen sources as a log: samples in the frames of `icrtool`, by one clock, with what a user must know of them."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from icrtool.config import Config
from icrtool.errors import ConfigError, DataError, LogError
from icrtool.kernels.arrays import Bools, Floats, Ints
from icrtool.logs.containers.container import Channel
from icrtool.logs.messages.topic_table import DISORDER_NS, TopicTable
from icrtool.logs.streams.bursts import spread_bursts, spread_positions
from icrtool.logs.streams.gyro_units import DEGREE, is_in_degrees, is_too_fast
from icrtool.logs.streams.headings import GYRO_AXES, GYRO_TYPE, find_gyro, inertial_units
from icrtool.logs.streams.positions import antenna_place
from icrtool.logs.streams.select import Candidates, Choice, choose_streams, ignored_joints, other_references
from icrtool.logs.streams.sources import (
    BY_LOG,
    NO_HEADER,
    Clock,
    HeadingSource,
    PositionSource,
    Source,
    StampedRows,
    WheelSource,
    as_replayed,
    by_header,
    by_log,
    increasing_rows,
    replay_speed,
    share_clock,
    stamp_rows,
)
from icrtool.logs.streams.wheel_pairs import topic_of_side
from icrtool.records.notes import Note, note, notes_about
from icrtool.records.samples import (
    NO_HEADINGS,
    Datum,
    GyroAxes,
    HeadingSamples,
    HeadingSensor,
    InputFile,
    OtherReceiver,
    PositionFixes,
    Role,
    Samples,
    StreamChoice,
    WheelSamples,
    WheelUnit,
    rate_and_jitter,
)
from icrtool.records.tables import RobotLog
from icrtool.records.text import LogText, listed

MOST_PIECES = 10.0
"""Largest mean number of pieces into which sorting cuts a stretch of messages. With more, it was recorded while times
repeated."""

FAR_NS = 100_000_000
"""Largest delay of log time after header stamps [ns] with which these are used together with log times of other
streams."""


@dataclass(frozen=True, slots=True)
class Survey:
    """A log after one pass: its channels, all candidates, the messages that could not be read, its files.

    Attributes
    ----------
    tables : columns that no candidate holds: stamps, turn rates, static transforms
    transfer : how much came over a connection, in words; empty for a file on disk
    """

    name: LogText
    path: str
    channels: tuple[Channel, ...]
    tables: tuple[TopicTable, ...]
    candidates: Candidates
    problems: tuple[Note, ...]
    inputs: tuple[InputFile, ...]
    transfer: str = ""


def assemble(survey: Survey, config: Config) -> RobotLog:
    """Return the log with its streams chosen and converted; errors as `read_log`."""
    lost = _lost(survey)
    if lost and survey.tables and not any(len(table) or table.unreadable for table in survey.tables):
        why = f"no message of {listed([table.topic for table in survey.tables], 3)} could be read: {lost}"
        raise LogError(survey.path, why, "copy the log again from where it was recorded")
    choice = choose_streams(survey.candidates, config, survey.path, survey.channels, lost)
    log = _assemble(survey, config, choice)
    others = []
    for other in other_references(survey.candidates, choice, config):
        # a reference that cannot be used is no alternative
        with contextlib.suppress(DataError):
            others.append(_assemble(survey, config, other))
    return replace(log, other_references=tuple(others)) if others else log


def _lost(survey: Survey) -> str:
    """Return the first thing that could not be read of a log, and how many more there are; empty where all was read."""
    if not survey.problems:
        return ""
    first, *others = survey.problems
    text = first.text if first.subject == Path(survey.path).name else first.sentence
    return f"{text} (icrtool info lists {len(others)} more)" if others else text


def _assemble(survey: Survey, config: Config, choice: Choice) -> RobotLog:
    """Return the log with the streams of a choice, converted."""
    candidates, name = survey.candidates, survey.name
    motion, position, source = choice.wheels, choice.gnss, choice.heading
    chosen: dict[Role, Source] = {"wheels": motion, "gnss": position}
    if source is not None:
        chosen["heading"] = source
    retime, notes = _clock_of(chosen, config)
    chosen = {role: replace(one, stamps=retime(one.stamps)) for role, one in chosen.items()}
    motion, position = replace(motion, stamps=retime(motion.stamps)), replace(position, stamps=retime(position.stamps))
    source = None if source is None else replace(source, stamps=retime(source.stamps))
    clock = common_clock([one.stamps for one in chosen.values()])
    if clock == "log":
        far = "one stream has no header stamps, and the header stamps of another are far from log time"
        notes.append(note("log_time_used", f"{far}; log time is used for all streams"))
    notes += clock_notes([(role, one.stamps) for role, one in chosen.items()], name)
    position, source, of_bursts = _spread(position, source, clock)
    notes += of_bursts
    notes += _far_datum(position, config)
    gnss, datum = _fixes(position, config, clock)
    heading, convention = (NO_HEADINGS, "") if source is None else _headings(source, config, clock)
    wheels, wheel_notes = wheel_samples(motion, motion.stamps.on(clock), config, name)
    notes += wheel_notes + ignored_joints(motion, config)
    notes += [note(reported.code, f"{one.topic}: {reported.text}") for one in chosen.values() for reported in one.notes]
    if source is None:
        notes += [
            note("heading_unusable", f"{one.topic} gives no heading: {one.problem}") for one in candidates.heading
        ]
    notes += _unreadable_notes(survey.tables, chosen.values())
    antenna = antenna_place(survey.tables, position.topic)
    place = "" if antenna is None else f"antenna {antenna[0]:+z.2f} m forward, {antenna[1]:+z.2f} m right of the base"
    read: dict[Role, tuple[Samples, str]] = {
        "wheels": (wheels, "; position" if wheels.from_position else "; speed"),
        "gnss": (gnss, f"; {place} (/tf_static)" if place else ""),
        "heading": (heading, f"; {convention}"),
    }
    streams = tuple(_stream_choice(role, one, *read[role], clock) for role, one in chosen.items())
    # The fixes of the other GNSS receivers lie in the local plane of the chosen one.
    others = [
        one for one in candidates.gnss if one.geodetic is not None and not one.problem and one.topic != position.topic
    ]
    others = [replace(one, stamps=retime(one.stamps)) for one in others]
    receivers = [OtherReceiver(one.topic, _fixes(one, config, clock, datum)[0]) for one in others if datum is not None]
    rows_of_role: dict[str, StampedRows] = {
        table.topic: retime(stamp_rows(table)) for table in survey.tables if table.message_type == GYRO_TYPE
    }
    gyro = find_gyro(survey.tables, motion.topic, "" if source is None else source.topic, clock, rows_of_role)
    gyros, degrees = _gyros(inertial_units(survey.tables, GYRO_AXES, clock, rows_of_role), heading, gnss)
    if gyro is not None and gyro.topic in degrees:
        gyro = replace(gyro, rate_radps=gyro.rate_radps * DEGREE)
    gyro = None if gyro is not None and is_too_fast(gyro.rate_radps[:, None]) else gyro
    notes += [note("gyro_in_degrees", f"{one}: its turn rates are in deg/s, not rad/s: converted") for one in degrees]
    log = RobotLog(
        name, wheels, gnss, heading, datum, streams, survey.inputs, dict(position.rejected),
        (*survey.problems, *notes_about(name, notes)), antenna, gyro, gyros, tuple(receivers),
        heading_sensor=None if source is None else _heading_sensor(source, config),
    )  # fmt: skip
    return longest_part(log)


def _unreadable_notes(tables: Iterable[TopicTable], chosen: Iterable[Source]) -> list[Note]:
    """Return a finding for each chosen topic with messages that do not fit their type."""
    unreadable: dict[str, int] = {table.topic: table.unreadable for table in tables if table.unreadable}
    used_topics = [topic_of_side(side) for one in chosen for side in one.topic.split(" + ")]
    return [
        note("messages_unreadable", f"{topic}: {unreadable[topic]} messages do not fit their message type; left out")
        for topic in dict.fromkeys(used_topics)
        if topic in unreadable
    ]


def _stream_choice(role: Role, source: Source, samples: Samples, detail: str, clock: Clock) -> StreamChoice:
    """Return what run.json states of a stream: its source, number, rate and clock; `detail` is added to the reason."""
    used = clock if source.stamps.header_ns is not None else "log"
    rate, jitter = rate_and_jitter(samples.stamp_ns)
    return StreamChoice(
        role, source.topic, source.message_type, len(samples.stamp_ns), rate, used, jitter, source.why + detail
    )


def _clock_of(chosen: Mapping[Role, Source], config: Config) -> tuple[Callable[[StampedRows], StampedRows], list[Note]]:
    """Return a function that puts stamps on the configured clock, or on the clock of all headers; and a note.

    Raises
    ------
    ConfigError
        Header stamps are configured and a stream has none that can be used.
    """
    if config.topics.clock == "log":
        return by_log, []
    if config.topics.clock == "header":
        for one in chosen.values():
            if one.stamps.header_ns is None and one.stamps.far_ns is None:
                why = f"{one.topic} has no header stamps that can be used ({one.stamps.note})"
                raise ConfigError("topics.clock", why, "set it to auto or log")
        return by_header, []
    far = [one.stamps for one in chosen.values() if one.stamps.far_ns is not None]
    others = [one for one in chosen.values() if one.stamps.far_ns is None]
    if share_clock(far) and all(one.stamps.note == NO_HEADER for one in others):
        speed = replay_speed(far[0])
        goes = f", which goes {speed:.3g} times as fast as log time (a replay at that speed, or a simulation)"
        if not others:
            why = f"{far[0].note} and are of one clock in all streams{goes if speed != 1.0 else ', as simulated time'}"
            return by_header, [note("header_clock", f"{why}: they are used")]
        if speed != 1.0:
            without = ", ".join(one.topic for one in others)
            why = f"{far[0].note} and are of one clock{goes}: they are used, and {without} is put on that clock"
            return lambda rows: as_replayed(rows, far[0]), [note("header_clock", why)]
    return lambda rows: rows, []


def _gyros(
    units: Iterable[tuple[TopicTable, Ints, Sequence[Floats]]], heading: HeadingSamples, gnss: PositionFixes
) -> tuple[tuple[GyroAxes, ...], list[str]]:
    """Return the inertial units with their rates in rad/s, and the topics that sent deg/s."""
    gyros, degrees = list[GyroAxes](), list[str]()
    for table, stamps, axes in units:
        rates = np.array(axes).T
        if is_in_degrees(stamps, rates, heading, gnss):
            degrees.append(table.topic)
            rates *= DEGREE
        if not is_too_fast(rates):
            gyros.append(GyroAxes(table.topic, stamps, rates))
    return tuple(gyros), degrees


def clock_notes(streams: Sequence[tuple[Role, StampedRows]], name: str) -> Iterator[Note]:
    """Yield findings about clocks: one for all clocks that were set, one for each clock that cannot be used.

    Raises
    ------
    DataError
        The clock was set back, and times repeat: nothing shows which of two samples came first.
    """
    back = [
        (rows.backward_step, role)
        for role, rows in streams
        if rows.backward_step.pieces > MOST_PIECES or rows.backward_step.step_ns > DISORDER_NS
    ]
    if back:
        # The largest step among the streams in which times repeat, if there are any: they decide what can be done.
        largest = max(back, key=lambda one: (one[0].pieces > MOST_PIECES, one[0].step_ns))[0]
        moment, roles = np.datetime64(largest.before_ns // 10**9, "s"), ", ".join(role for _, role in back)
        why = f"log time goes back by {largest.step_ns / 1e9:.1f} s after {moment}Z ({roles})"
        if largest.pieces <= MOST_PIECES:
            cause = "the clock was set back, or messages are stored out of order; all are used, sorted by time"
            yield note("clock_set", f"{why}: {cause}; if it was set back, fit each part alone (--from, --to)")
        elif largest.step_ns <= DISORDER_NS:
            mixed = "samples of that time are mixed, which makes errors there too large"
            reported = f"{why}: the clock was set back while recording, and {mixed}; fit each part alone (--from, --to)"
            yield note("clock_set", reported)
        else:
            raise DataError(name, why, "times come again, and samples cannot be put in order; cut the recording there")
    if clocks_set := [(rows.clock_set, role) for role, rows in streams if rows.clock_set.size_ns]:
        size_ns, is_back, before_ns = max(clocks_set)[0]
        sense, setting = ("back", "back") if is_back else ("ahead", "forward")
        moment, roles = np.datetime64(before_ns // 10**9, "s"), ", ".join(role for _, role in clocks_set)
        why = f"header stamps go {sense} by {size_ns / 1e9:.1f} s after {moment}Z ({roles})"
        moved = "the later stamps are moved by that step, which log time shows"
        yield note("clock_set", f"{why}: their clock was set {setting} while recording; {moved}")
    for role, rows in streams:
        if rows.note and rows.note not in (NO_HEADER, BY_LOG):
            yield note("log_time_used", f"{role}: {rows.note}; log time is used")
        if rows.replaced > 1:
            counted = f"{rows.replaced} of {len(rows.log_ns)} header stamps are of another clock"
            yield note("log_time_used", f"{role}: {counted}; log time is used for them")


def common_clock(streams: Sequence[StampedRows]) -> Clock:
    """Return the clock for streams that are used together: header stamps or log time.

    Where one stream has only log times and the header stamps of another are far from log time, all use log time.
    """
    delays = [rows.delay_ns for rows in streams if rows.header_ns is not None]
    return "log" if len(delays) < len(streams) and any(abs(delay) > FAR_NS for delay in delays) else "header"


FAR_DEG = 0.2
"""A fix this far from the median of all, about 20 km, is no origin of the local plane."""


def _fixes(
    source: PositionSource, config: Config, clock: Clock, given: Datum | None = None
) -> tuple[PositionFixes, Datum | None]:
    """Return positions in the local plane about the datum: `given`, else the configured one, else the first fix."""
    stamps = source.stamps.on(clock)
    rows = np.flatnonzero(source.usable)
    rows = rows[np.argsort(stamps[rows], kind="stable")]
    datum = given
    if source.geodetic is not None:
        from pymap3d import geodetic2ned

        latitude, longitude, height = source.geodetic[rows].T
        if datum is None:
            # a bad first fix would lay the plane far away
            apart = np.abs(latitude - np.median(latitude)) + np.abs(longitude - np.median(longitude))
            row = int(np.argmax(apart < FAR_DEG)) if (apart < FAR_DEG).any() else 0
            first = float(latitude[row]), float(longitude[row])
            given_datum = None if _far_datum(source, config) else config.frames.datum
            datum = Datum(*(given_datum or first), float(height[0]))
        origin = datum.latitude_deg, datum.longitude_deg, datum.height_m
        north, east, _ = geodetic2ned(latitude, longitude, height, *origin)
    else:
        north, east = np.asarray(source.metric, np.float64)[rows].T
    north, east, var_north, var_east, covariance = (
        np.ascontiguousarray(one, np.float64) for one in (north, east, *source.variance[rows].T)
    )
    stated = None if source.stated_class is None else source.stated_class[rows]
    return PositionFixes(stamps[rows], north, east, var_north, var_east, covariance, stated), datum


FAR_TURN_RAD, FAR_DATUM_M = math.radians(0.5), 285e3
"""Turn of a local plane at the fixes, and distance, above which its origin is too far away [rad, m]. At this distance
the plane is 0.1 % too small; a smaller turn is found and corrected with the heading."""

MEAN_EARTH_RADIUS_M = 6_371_000.0
"""Mean radius of the earth [m]."""


def _far_datum(source: PositionSource, config: Config) -> list[Note]:
    """Return a note where the configured origin is too far from the fixes for one plane; none where it is near.

    Notes
    -----
    Distance on the sphere by the haversine formula; north turns by the difference of the longitudes times the sine of
    the latitude (Snyder 1987, Map Projections).
    """
    if config.frames.datum is None or source.geodetic is None:
        return []
    latitude, longitude = np.median(source.geodetic[source.usable, :2], axis=0).tolist()
    (lat, lon), (lat_0, lon_0) = np.radians([(latitude, longitude), config.frames.datum]).tolist()
    apart = math.remainder(lon - lon_0, 2.0 * math.pi)
    turn, middle = apart * math.sin((lat + lat_0) / 2), math.cos(lat) * math.cos(lat_0) * math.sin(apart / 2) ** 2
    far_m = 2.0 * MEAN_EARTH_RADIUS_M * math.asin(min(math.sqrt(math.sin((lat - lat_0) / 2) ** 2 + middle), 1.0))
    if abs(turn) <= FAR_TURN_RAD and far_m <= FAR_DATUM_M:
        return []
    what = f"frames.datum lies {far_m / 1e3:,.0f} km from the fixes ({latitude:.4f}, {longitude:.4f})"
    plane = f"its local plane is turned by {abs(math.degrees(turn)):.1f}° there"
    why = f"{what}, and {plane}: the first fix is the datum instead; correct frames.datum, [latitude, longitude]"
    return [note("datum_far", why)]


def _spread(
    position: PositionSource, heading: HeadingSource | None, clock: Clock
) -> tuple[PositionSource, HeadingSource | None, list[Note]]:
    """Return the sources with their stamps spread where positions come several at a time or share a stamp, and a note.

    Rows that are not used keep their stamps. Headings of the topic of the positions have the stamps of their positions
    if both are in the same messages; if they are sentences in messages of their own, they are spread by themselves.
    """
    rows, stamps = np.flatnonzero(position.usable), position.stamps
    if position.geodetic is not None:
        latitude, longitude, _ = np.radians(position.geodetic[rows]).T
        place = MEAN_EARTH_RADIUS_M * (latitude + 1j * longitude * np.cos(latitude))
    else:
        place = np.asarray(position.metric, np.float64)[rows] @ np.array([1.0, 1j])
    by_header = clock == "header" and stamps.header_ns is not None
    bursts = spread_positions(stamps.on(clock)[rows], place, measured=by_header)
    if not (text := bursts.sentence("fixes" if position.geodetic is not None else "poses")):
        return position, heading, []
    if heading is not None and (heading.topic, heading.message_type) == (position.topic, position.message_type):
        own, used = bursts, position.usable
        if not np.array_equal(heading.stamps.on(clock), stamps.on(clock)):
            own, used = spread_bursts(heading.stamps.on(clock)[heading.usable]), heading.usable
            own = own.as_shared() if bursts.shared else own
        heading = replace(heading, stamps=_moved(heading.stamps, used, own.stamp_ns, clock))
    moved = _moved(stamps, position.usable, bursts.stamp_ns, clock)
    return replace(position, stamps=moved), heading, [note("fix_bursts", f"{position.topic}: {text}")]


def _moved(rows: StampedRows, used: Bools, stamp_ns: Ints, clock: Clock) -> StampedRows:
    """Return stamps of which those used (n,) are replaced on a clock; the others stay as they are."""
    moved = rows.on(clock).copy()
    moved[used] = stamp_ns
    is_header = clock == "header" and rows.header_ns is not None
    return replace(rows, header_ns=moved) if is_header else replace(rows, log_ns=moved)


def _headings(source: HeadingSource, config: Config, clock: Clock) -> tuple[HeadingSamples, str]:
    """Return headings clockwise from north, and a text on how the convention is known."""
    convention = _heading_sensor(source, config).convention
    why = source.convention_why if config.frames.heading == "auto" else "configured"
    stamps = source.stamps.on(clock)
    rows, _, _ = increasing_rows(stamps, source.usable)
    samples = HeadingSamples(stamps[rows], source.heading_rad(convention)[rows], source.variance[rows])
    return samples, f"{convention.upper()} ({why})"


def _heading_sensor(source: HeadingSource, config: Config) -> HeadingSensor:
    """Return the topic of a heading, and the convention that it is read with."""
    convention = source.convention if config.frames.heading == "auto" else config.frames.heading
    return HeadingSensor(source.topic, source.message_type, convention)


MOST_NOT_FINITE = 0.01
"""Largest share of wheel samples without a number that is not reported."""


def wheel_samples(motion: WheelSource, stamps: Ints, config: Config, log_name: str) -> tuple[WheelSamples, list[Note]]:
    """Return wheel speeds held over each interval, in the unit of the log, and findings.

    Returns
    -------
    samples, findings

    Raises
    ------
    ConfigError
        A body twist whose track width is not configured, or a configured quantity that the topic does not have.
    DataError
        Fewer than two usable samples.
    """
    topic, notes = motion.topic, list[Note]()
    left, right, unit, is_position = _pick(motion, config)
    if not _is_doubled(stamps, left, right):
        bursts = spread_bursts(stamps)
        stamps = bursts.stamp_ns
        text = bursts.sentence("wheel samples")
        notes += [note("wheel_bursts", f"{topic}: {text}")] if text else []
    rows, backwards, dropped = increasing_rows(stamps)
    if backwards:
        notes.append(note("rows_sorted", f"{topic}: {backwards} wheel stamps go back; sorted"))
    if dropped > len(stamps) // 100:
        shared = f"{dropped} of {len(stamps)} wheel samples share a stamp with another"
        notes.append(note("stamps_shared", f"{topic}: {shared}; the last was kept"))
    left, right = left[rows], right[rows]
    finite = np.isfinite(left) & np.isfinite(right)
    lost = len(finite) - int(np.count_nonzero(finite))
    if lost > len(finite) * MOST_NOT_FINITE:
        why = f"{topic}: {lost} of {len(finite)} wheel samples are not finite numbers; left out"
        notes.append(note("samples_not_finite", why))
    stamps, left, right = stamps[rows][finite], left[finite], right[finite]
    if len(stamps) < 2:
        raise DataError(log_name, f"{topic} holds {len(stamps)} usable wheel samples", "at least two are needed")
    if is_position:
        interval = np.diff(stamps) / 1e9
        with np.errstate(over="ignore"):
            left, right = (np.append(np.diff(side) / interval, 0.0) for side in (left, right))
        left[-1], right[-1] = left[-2], right[-2]
    if motion.twist is not None and config.wheels.twist_width_m is None:
        undone = f"converted to wheel speeds with {config.robot.track_width_m:g} m (robot.track_width_m)"
        advice = "if its controller multiplies the wheel separation, set wheels.twist_width_m to the product"
        why = f"{topic} holds a body twist: {undone}; {advice}, else the estimated ICRs are too close together"
        notes.append(note("wheels_from_twist", why))
    return WheelSamples(stamps, left, right, unit, is_position), notes


def _is_doubled(stamps: Ints, left: Floats, right: Floats) -> bool:
    """Return whether samples with the stamp of the one before mostly have its values: messages recorded twice."""
    again = np.flatnonzero(np.diff(stamps) == 0)
    moving = again[(left[again] != 0.0) | (right[again] != 0.0)]
    same = (left[moving] == left[moving + 1]) & (right[moving] == right[moving + 1])
    return len(moving) > 0 and float(same.mean()) > 0.5


def _pick(motion: WheelSource, config: Config) -> tuple[Floats, Floats, WheelUnit, bool]:
    """Return left, right, their unit, and whether they are positions."""
    if motion.twist is not None:
        given = config.wheels.twist_width_m
        width = given if given is not None else config.robot.track_width_m
        if width is None:
            why = f"needed to convert the body twist of {motion.topic} to wheel speeds"
            raise ConfigError("robot.track_width_m", why, "give it, or --robot NAME")
        if motion.travelled is not None:
            travel, turn = motion.travelled.T
            return travel - turn * width / 2, travel + turn * width / 2, "m", True
        speed, turn = motion.twist.T
        with np.errstate(over="ignore", invalid="ignore"):
            return speed - turn * width / 2, speed + turn * width / 2, "m", False
    wanted, positions, speeds = config.wheels.quantity, motion.position, motion.speed
    if wanted in ("position", "counts") and positions is None:
        raise ConfigError("wheels.quantity", f"{motion.topic} has no {wanted}", "leave it on auto")
    stuck = False
    if wanted == "auto" and positions is not None and speeds is not None:
        # Some drivers leave the position at zero.
        finite = np.isfinite(positions[0]) & np.isfinite(positions[1])
        stuck = int(np.count_nonzero(finite)) < len(finite) / 2 or any(
            np.ptp(travelled[finite]) == 0.0 and np.nanmax(np.abs(speed)) > 0.0
            for travelled, speed in zip(positions, speeds, strict=True)
        )
    factor, unit = WHEEL_UNITS.get(config.wheels.unit, (1.0, motion.unit))
    if positions is not None and wanted != "velocity" and not stuck:
        if config.wheels.unit == "rpm":
            raise ConfigError(
                "wheels.unit", f"{motion.topic} holds positions, which have no rpm", "give rad/s or deg/s"
            )
        left, right = positions
        return left * factor, right * factor, "counts" if wanted == "counts" else unit, True
    if speeds is None:
        raise ConfigError("wheels.quantity", f"{motion.topic} has no velocity of both sides", "leave it on auto")
    left, right = speeds
    return left * factor, right * factor, unit, False


WHEEL_UNITS: dict[str, tuple[float, WheelUnit]] = {
    "rad/s": (1.0, "rad"), "deg/s": (math.radians(1.0), "rad"), "rpm": (2 * math.pi / 60, "rad"),
    "m/s": (1.0, "m"), "counts": (1.0, "counts"),
}  # fmt: skip
"""Configured units of wheels: the factor of the numbers, and the unit of the products, per second for speeds."""

PAUSE_S = 600.0
"""Longest interval between samples that is not reported [s]."""

LONGEST_PAUSE_S = 86_400.0
"""Interval between samples from which a log counts as two recordings [s]."""


def longest_part(log: RobotLog) -> RobotLog:
    """Return a log without samples of another clock, and with a finding where its clock may have been set forward.

    Of parts at least `LONGEST_PAUSE_S` apart, the part with the most wheel samples and positions is kept.
    """
    stamps, fixes, pause_ns = log.wheels.stamp_ns, log.gnss.stamp_ns, int(LONGEST_PAUSE_S * 1e9)
    ends = np.append(np.flatnonzero(np.diff(stamps) > pause_ns), len(stamps) - 1)
    begins = np.append(0, ends[:-1] + 1)
    positions = np.searchsorted(fixes, stamps[ends], side="right") - np.searchsorted(fixes, stamps[begins])
    longest = int(np.argmax((ends - begins) * (positions > 1)))
    first, last = stamps[begins[longest]], stamps[ends[longest]]
    parts: dict[str, Any] = {}
    lost, paused = [], list[Note]()
    for role, margin_ns in (("wheels", 0), ("gnss", pause_ns), ("heading", pause_ns)):
        samples: Samples = getattr(log, role)
        inside = (samples.stamp_ns >= first - margin_ns) & (samples.stamp_ns <= last + margin_ns)
        samples_kept = parts[role] = samples if inside.all() else samples.cut(inside)
        if samples_kept is not samples:
            lost.append(f"{len(inside) - len(samples_kept.stamp_ns)} of {len(inside)} ({role})")
        longest_s = np.diff(samples_kept.stamp_ns).max(initial=0) / 1e9
        if longest_s > PAUSE_S:
            why = "the recording was paused, or its clock was set forward"
            paused.append(note("recording_paused", f"{role}: no samples for {longest_s:.0f} s: {why}"))
    notes = paused[:1]
    if lost:
        why = f"more than a day apart from the other samples, and left out: {', '.join(lost)}; if the clock was set, "
        notes.insert(0, note("samples_days_apart", f"{why}--from and --to read that part"))
    return replace(log, notes=(*log.notes, *notes_about(log.name, notes)), **parts)
