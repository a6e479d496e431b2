"""Assembly of a log from the chosen sources: samples in the frames of `icrtool`, on one clock, with findings."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

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
    increasing_rows,
    put_on_replay_clock,
    replay_speed,
    share_clock,
    stamp_rows,
    use_header_stamps,
    use_log_times,
)
from icrtool.logs.streams.wheel_pairs import topic_of_side
from icrtool.logs.streams.wheel_samples import wheel_samples
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
    rate_and_jitter,
)
from icrtool.records.tables import RobotLog
from icrtool.records.text import LogText, listed

MOST_PIECES = 10.0
"""Largest mean number of pieces of `BackwardStep` with which samples can be sorted. More pieces show that the same log
times occurred twice."""

LONGEST_LOG_DELAY_NS = 100_000_000
"""Largest delay of log time after header stamps with which the header stamps of one stream are used together with the
log times of another [ns]."""


@dataclass(frozen=True, slots=True)
class Survey:
    """Content of a log after one pass over its messages.

    Attributes
    ----------
    name : name of the log
    path : path of the log in errors
    channels : all channels of the log
    tables : columns that are in no candidate: stamps, turn rates, static transforms
    candidates : the sources that may feed a role
    problems : findings about data that could not be read
    inputs : files of the log with their SHA-256
    transfer : text about the data that was transferred over a connection; empty for a file on disk
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
    """Return the log with its streams chosen and converted to the frames and units of `icrtool`.

    Raises
    ------
    LogError
        No message of the used topics could be read.
    ConfigError
        A configured topic, joint or unit does not fit the log.
    MissingStreamError
        The log has no wheels or no positions.
    DataError
        A stream cannot be used.
    """
    lost = _unreadable_text(survey)
    if lost and survey.tables and not any(len(table) or table.unreadable for table in survey.tables):
        why = f"no message of {listed([table.topic for table in survey.tables], 3)} could be read: {lost}"
        raise LogError(survey.path, why, "copy the log again from where it was recorded")
    choice = choose_streams(survey.candidates, config, survey.path, survey.channels, lost)
    log = _assemble_choice(survey, config, choice)
    others = []
    for other in other_references(survey.candidates, choice, config):
        # A reference that cannot be used is left out.
        with contextlib.suppress(DataError):
            others.append(_assemble_choice(survey, config, other))
    return replace(log, other_references=tuple(others)) if others else log


def _unreadable_text(survey: Survey) -> str:
    """Return the first finding about unreadable data, and the number of further ones; empty if all was read."""
    if not survey.problems:
        return ""
    first, *others = survey.problems
    text = first.text if first.subject == Path(survey.path).name else first.sentence
    return f"{text} (icrtool info lists {len(others)} more)" if others else text


def _assemble_choice(survey: Survey, config: Config, choice: Choice) -> RobotLog:
    """Return the log with the streams of a choice, converted; raise as `assemble`."""
    candidates, name = survey.candidates, survey.name
    retime, notes = _choose_clock(choice, config)
    wheel_source, position_source = _retimed(choice.wheels, retime), _retimed(choice.gnss, retime)
    heading_source = None if choice.heading is None else _retimed(choice.heading, retime)
    chosen: dict[Role, Source] = {"wheels": wheel_source, "gnss": position_source}
    if heading_source is not None:
        chosen["heading"] = heading_source
    clock = common_clock([source.stamps for source in chosen.values()])
    if clock == "log":
        text = "one stream has no header stamps, and the header stamps of another are far from log time"
        notes.append(note("log_time_used", f"{text}; log time is used for all streams"))
    notes += clock_notes([(role, source.stamps) for role, source in chosen.items()], name)
    position_source, heading_source, burst_notes = _spread_stamps(position_source, heading_source, clock)
    notes += burst_notes
    notes += _datum_notes(position_source, config)
    gnss, datum = _local_fixes(position_source, config, clock)
    heading, convention = (
        (NO_HEADINGS, "") if heading_source is None else _convert_headings(heading_source, config, clock)
    )
    wheels, wheel_notes = wheel_samples(wheel_source, wheel_source.stamps.on(clock), config, name)
    notes += wheel_notes + ignored_joints(wheel_source, config)
    notes += [
        note(reported.code, f"{source.topic}: {reported.text}")
        for source in chosen.values()
        for reported in source.notes
    ]
    if heading_source is None:
        notes += [
            note("heading_unusable", f"{candidate.topic} gives no heading: {candidate.problem}")
            for candidate in candidates.heading
        ]
    notes += _unreadable_notes(survey.tables, chosen.values())
    antenna_m = antenna_place(survey.tables, position_source.topic)
    antenna = (
        "" if antenna_m is None else f"antenna {antenna_m[0]:+z.2f} m forward, {antenna_m[1]:+z.2f} m right of the base"
    )
    read: dict[Role, tuple[Samples, str]] = {
        "wheels": (wheels, "; position" if wheels.from_position else "; speed"),
        "gnss": (gnss, f"; {antenna} (/tf_static)" if antenna else ""),
        "heading": (heading, f"; {convention}"),
    }
    streams = tuple(_stream_choice(role, source, *read[role], clock) for role, source in chosen.items())
    rows_of_topic: dict[str, StampedRows] = {
        table.topic: retime(stamp_rows(table)) for table in survey.tables if table.message_type == GYRO_TYPE
    }
    heading_topic = "" if heading_source is None else heading_source.topic
    gyro = find_gyro(survey.tables, wheel_source.topic, heading_topic, clock, rows_of_topic)
    gyros, degrees = _convert_gyros(inertial_units(survey.tables, GYRO_AXES, clock, rows_of_topic), heading, gnss)
    if gyro is not None and gyro.topic in degrees:
        gyro = replace(gyro, rate_radps=gyro.rate_radps * DEGREE)
    gyro = None if gyro is not None and is_too_fast(gyro.rate_radps[:, None]) else gyro
    notes += [
        note("gyro_in_degrees", f"{topic}: its turn rates are in deg/s, not rad/s: converted") for topic in degrees
    ]
    receivers = _other_receivers(candidates.gnss, position_source.topic, retime, config, clock, datum)
    log = RobotLog(
        name, wheels, gnss, heading, datum, streams, survey.inputs, dict(position_source.rejected),
        (*survey.problems, *notes_about(name, notes)), antenna_m, gyro, gyros, receivers,
        heading_sensor=None if heading_source is None else _heading_sensor(heading_source, config),
    )  # fmt: skip
    return longest_part(log)


AnySource = TypeVar("AnySource", bound=Source)
"""Class of a source: wheels, positions or headings."""


def _retimed(source: AnySource, retime: Callable[[StampedRows], StampedRows]) -> AnySource:
    """Return a source with its stamps on the clock to use."""
    return replace(source, stamps=retime(source.stamps))


def _other_receivers(
    sources: Iterable[PositionSource], chosen_topic: str, retime: Callable[[StampedRows], StampedRows], config: Config,
    clock: Clock, datum: Datum | None,
) -> tuple[OtherReceiver, ...]:  # fmt: skip
    """Return the fixes of the other GNSS receivers, in the local plane of the chosen one; none without a datum."""
    if datum is None:
        return ()
    others = (
        _retimed(source, retime)
        for source in sources
        if source.geodetic is not None and not source.problem and source.topic != chosen_topic
    )
    return tuple(OtherReceiver(source.topic, _local_fixes(source, config, clock, datum)[0]) for source in others)


def _unreadable_notes(tables: Iterable[TopicTable], chosen: Iterable[Source]) -> list[Note]:
    """Return a finding for each chosen topic with messages that do not fit their type."""
    unreadable: dict[str, int] = {table.topic: table.unreadable for table in tables if table.unreadable}
    used_topics = [topic_of_side(side) for source in chosen for side in source.topic.split(" + ")]
    return [
        note("messages_unreadable", f"{topic}: {unreadable[topic]} messages do not fit their message type; left out")
        for topic in dict.fromkeys(used_topics)
        if topic in unreadable
    ]


def _stream_choice(role: Role, source: Source, samples: Samples, detail: str, clock: Clock) -> StreamChoice:
    """Return the entry of a stream in run.json: its source, number of samples, rate and clock.

    Parameters
    ----------
    detail : text that is added to the reason of the choice
    """
    used = clock if source.stamps.header_ns is not None else "log"
    rate, jitter = rate_and_jitter(samples.stamp_ns)
    return StreamChoice(
        role, source.topic, source.message_type, len(samples.stamp_ns), rate, used, jitter, source.why + detail
    )


def _choose_clock(choice: Choice, config: Config) -> tuple[Callable[[StampedRows], StampedRows], list[Note]]:
    """Return a function that puts stamps on the clock to use, and a finding about this clock.

    The clock is the configured one; with ``auto``, a clock of header stamps that all streams share is used.

    Raises
    ------
    ConfigError
        Header stamps are configured and a stream has none that can be used.
    """
    if config.topics.clock == "log":
        return use_log_times, []
    sources = [source for source in (choice.wheels, choice.gnss, choice.heading) if source is not None]
    if config.topics.clock == "header":
        for stream in sources:
            if stream.stamps.header_ns is None and stream.stamps.far_ns is None:
                why = f"{stream.topic} has no header stamps that can be used ({stream.stamps.note})"
                raise ConfigError("topics.clock", why, "set it to auto or log")
        return use_header_stamps, []
    far_streams = [stream.stamps for stream in sources if stream.stamps.far_ns is not None]
    others = [stream for stream in sources if stream.stamps.far_ns is None]
    if share_clock(far_streams) and all(stream.stamps.note == NO_HEADER for stream in others):
        speed = replay_speed(far_streams[0])
        pace = f", which runs {speed:.3g} times as fast as log time (a replay at that speed, or a simulation)"
        if not others:
            clock = f"one clock in all streams{pace if speed != 1.0 else ', such as simulated time'}"
            return use_header_stamps, [
                note("header_clock", f"{far_streams[0].note}, and come from {clock}: they are used")
            ]
        if speed != 1.0:
            without = ", ".join(stream.topic for stream in others)
            clock = f"one clock{pace}"
            text = f"{far_streams[0].note}, and come from {clock}: they are used, and {without} is put on that clock"
            return lambda rows: put_on_replay_clock(rows, far_streams[0]), [note("header_clock", text)]
    return lambda rows: rows, []


def _convert_gyros(
    units: Iterable[tuple[TopicTable, Ints, Sequence[Floats]]], heading: HeadingSamples, gnss: PositionFixes
) -> tuple[tuple[GyroAxes, ...], list[str]]:
    """Return the inertial units with their turn rates in rad/s, and the topics whose rates were in deg/s."""
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
    """Yield findings about clocks that were set, and about streams whose header stamps cannot be used.

    Parameters
    ----------
    streams : role and stamps of each stream
    name : name of the log in errors

    Raises
    ------
    DataError
        The clock was set back so far that the same log times occur twice, and samples cannot be put in order.
    """
    back = [
        (rows.backward_step, role)
        for role, rows in streams
        if rows.backward_step.pieces > MOST_PIECES or rows.backward_step.step_ns > DISORDER_NS
    ]
    if back:
        # Streams in which the same times occur twice come first, because they cannot be sorted.
        largest = max(back, key=lambda step_of_role: (step_of_role[0].pieces > MOST_PIECES, step_of_role[0].step_ns))[0]
        moment, roles = np.datetime64(largest.before_ns // 10**9, "s"), ", ".join(role for _, role in back)
        why = f"log time goes back by {largest.step_ns / 1e9:.1f} s after {moment}Z ({roles})"
        if largest.pieces <= MOST_PIECES:
            cause = "the clock was set back, or messages are stored out of order; all are used, sorted by time"
            yield note("clock_set", f"{why}: {cause}; if it was set back, fit each part alone (--from, --to)")
        elif largest.step_ns <= DISORDER_NS:
            mixed = "samples of that time are mixed, so that errors there are too large"
            reported = f"{why}: the clock was set back while recording, and {mixed}; fit each part alone (--from, --to)"
            yield note("clock_set", reported)
        else:
            raise DataError(name, why, "the same times occur twice; samples cannot be sorted; cut the recording there")
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
            counted = f"{rows.replaced} of {len(rows.log_ns)} header stamps come from another clock"
            yield note("log_time_used", f"{role}: {counted}; log time is used for them")


def common_clock(streams: Sequence[StampedRows]) -> Clock:
    """Return the clock of streams that are used together: ``header`` or ``log``.

    If one stream has only log times, and the header stamps of another are far from log time, it is ``log``.
    """
    delays = [rows.delay_ns for rows in streams if rows.header_ns is not None]
    return (
        "log" if len(delays) < len(streams) and any(abs(delay) > LONGEST_LOG_DELAY_NS for delay in delays) else "header"
    )


LARGEST_DATUM_OFFSET_DEG = 0.2
"""Largest distance from the median of all fixes of a fix that may be the origin of the local plane [deg], about 20
km."""


def _local_fixes(
    source: PositionSource, config: Config, clock: Clock, given: Datum | None = None
) -> tuple[PositionFixes, Datum | None]:
    """Return positions in the local plane [m], north and east of its origin, and this origin.

    Parameters
    ----------
    given : the origin; None: the configured one, else the first fix
    """
    stamps = source.stamps.on(clock)
    rows = np.flatnonzero(source.usable)
    rows = rows[np.argsort(stamps[rows], kind="stable")]
    datum = given
    if source.geodetic is not None:
        from pymap3d import geodetic2ned

        latitude, longitude, height = source.geodetic[rows].T
        if datum is None:
            # With an outlier as first fix, the origin would be far from the drive.
            apart = np.abs(latitude - np.median(latitude)) + np.abs(longitude - np.median(longitude))
            row = int(np.argmax(apart < LARGEST_DATUM_OFFSET_DEG)) if (apart < LARGEST_DATUM_OFFSET_DEG).any() else 0
            first = float(latitude[row]), float(longitude[row])
            given_datum = None if _datum_notes(source, config) else config.frames.datum
            datum = Datum(*(given_datum or first), float(height[0]))
        origin = datum.latitude_deg, datum.longitude_deg, datum.height_m
        north, east, _ = geodetic2ned(latitude, longitude, height, *origin)
    else:
        north, east = np.asarray(source.metric, np.float64)[rows].T
    north, east, var_north, var_east, covariance = (
        np.ascontiguousarray(column, np.float64) for column in (north, east, *source.variance[rows].T)
    )
    stated = None if source.stated_class is None else source.stated_class[rows]
    return PositionFixes(stamps[rows], north, east, var_north, var_east, covariance, stated), datum


FAR_TURN_RAD, FAR_DATUM_M = math.radians(0.5), 285e3
"""Largest turn of the local plane at the fixes [rad], and largest distance of its origin from the fixes [m]. At this
distance lengths in the plane are 0.1 % too small. A smaller turn is found and corrected with the heading."""

MEAN_EARTH_RADIUS_M = 6_371_000.0
"""Mean radius of the earth [m]."""


def _datum_notes(source: PositionSource, config: Config) -> list[Note]:
    """Return a finding if the configured origin is too far from the fixes for one plane, else an empty list.

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
    distance = f"frames.datum lies {far_m / 1e3:,.0f} km from the fixes ({latitude:.4f}, {longitude:.4f})"
    plane = f"its local plane is turned by {abs(math.degrees(turn)):.1f}° there"
    text = f"{distance}, and {plane}: the first fix is the datum instead; correct frames.datum, [latitude, longitude]"
    return [note("datum_far", text)]


def _spread_stamps(
    position: PositionSource, heading: HeadingSource | None, clock: Clock
) -> tuple[PositionSource, HeadingSource | None, list[Note]]:
    """Return the sources with the stamps of packets of positions spread over time, and a finding about packets.

    Rows that are not used keep their stamps. Headings in the messages of the positions get the stamps of the positions.
    Headings in other messages of the same topic (NMEA sentences) are spread separately.
    """
    rows, stamps = np.flatnonzero(position.usable), position.stamps
    if position.geodetic is not None:
        latitude, longitude, _ = np.radians(position.geodetic[rows]).T
        position_m = MEAN_EARTH_RADIUS_M * (latitude + 1j * longitude * np.cos(latitude))
    else:
        position_m = np.asarray(position.metric, np.float64)[rows] @ np.array([1.0, 1j])
    uses_headers = clock == "header" and stamps.header_ns is not None
    bursts = spread_positions(stamps.on(clock)[rows], position_m, measured=uses_headers)
    if not (text := bursts.sentence("fixes" if position.geodetic is not None else "poses")):
        return position, heading, []
    if heading is not None and (heading.topic, heading.message_type) == (position.topic, position.message_type):
        heading_bursts, used = bursts, position.usable
        if not np.array_equal(heading.stamps.on(clock), stamps.on(clock)):
            heading_bursts, used = spread_bursts(heading.stamps.on(clock)[heading.usable]), heading.usable
            heading_bursts = heading_bursts.as_shared() if bursts.shared else heading_bursts
        heading = replace(heading, stamps=_with_stamps(heading.stamps, used, heading_bursts.stamp_ns, clock))
    spread = _with_stamps(stamps, position.usable, bursts.stamp_ns, clock)
    return replace(position, stamps=spread), heading, [note("fix_bursts", f"{position.topic}: {text}")]


def _with_stamps(rows: StampedRows, used: Bools, stamp_ns: Ints, clock: Clock) -> StampedRows:
    """Return stamps in which the stamps of the used rows (n,) by a clock are replaced by other stamps (m,) [ns]."""
    stamps = rows.on(clock).copy()
    stamps[used] = stamp_ns
    uses_headers = clock == "header" and rows.header_ns is not None
    return replace(rows, header_ns=stamps) if uses_headers else replace(rows, log_ns=stamps)


def _convert_headings(source: HeadingSource, config: Config, clock: Clock) -> tuple[HeadingSamples, str]:
    """Return headings clockwise from north [rad], and a text about their convention and how it is known."""
    convention = _heading_sensor(source, config).convention
    why = source.convention_why if config.frames.heading == "auto" else "configured"
    stamps = source.stamps.on(clock)
    rows, _, _ = increasing_rows(stamps, source.usable)
    samples = HeadingSamples(stamps[rows], source.heading_rad(convention)[rows], source.variance[rows])
    return samples, f"{convention.upper()} ({why})"


def _heading_sensor(source: HeadingSource, config: Config) -> HeadingSensor:
    """Return the topic of a heading, with the convention by which its angles are read."""
    convention = source.convention if config.frames.heading == "auto" else config.frames.heading
    return HeadingSensor(source.topic, source.message_type, convention)


PAUSE_S = 600.0
"""Interval between samples above which it is reported [s]."""

LONGEST_PAUSE_S = 86_400.0
"""Interval between samples above which a log counts as two recordings [s]."""


def longest_part(log: RobotLog) -> RobotLog:
    """Return the longest part of a log without a pause of `LONGEST_PAUSE_S`, with findings about pauses.

    The part with the most wheel samples is kept, among the parts with at least two positions.
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
            cause = "the recording was paused, or its clock was set forward"
            paused.append(note("recording_paused", f"{role}: no samples for {longest_s:.0f} s: {cause}"))
    notes = paused[:1]
    if lost:
        text = f"more than a day apart from the other samples, and left out: {', '.join(lost)}"
        advice = "if the clock was set, --from and --to read that part"
        notes.insert(0, note("samples_days_apart", f"{text}; {advice}"))
    return replace(log, notes=(*log.notes, *notes_about(log.name, notes)), **parts)
