"""What a batch has in common: one calibration per robot and group, tested on each log left out, and the groups."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from hashlib import sha256
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from icrtool import __version__
from icrtool.errors import IcrToolError
from icrtool.fleet.recordings import unique_name
from icrtool.output.files.atomic import make_folders
from icrtool.output.files.formats import logs_of_fleet, read_fleet, write_calibration
from icrtool.records.fleet_document import BUDGET_M, FLEET_FILE, FleetCalibration, FleetFile, FleetLog
from icrtool.records.regular_file import is_regular
from icrtool.records.run import ICR_COLUMNS, Run

CALIBRATIONS = "calibrations"
"""Folder of the calibration files below that of the batch."""

MOST_POOLED_S = 86_400.0
"""Of the logs of a robot and group, so much time is calibrated together, evenly spaced over all: about 1 GB."""


def pooled_calibrations(
    rows: Sequence[FleetLog], directory: Path, place: Path | None = None, *, allow_unusable: bool = False
) -> Iterator[FleetCalibration]:
    """Yield the calibration of each robot in each group; one of the same logs as before is not fitted again.

    Parameters
    ----------
    directory : of the batch, on disk; calibration files are written below it
    place : the address that it stands for, where the runs are
    allow_unusable : also from runs that are not usable
    """
    before = {one.key: one for one in _stored(directory)}
    names: set[str] = set()
    for (robot, group), members in groups_of(rows).items():
        key = sha256(
            msgspec.json.encode([__version__, allow_unusable, [(row.log, row.key, row.inputs) for row in members]])
        ).hexdigest()
        name = _file_name(robot, group, names)
        known = before.get(key)
        if known is not None and (not known.file or is_regular(directory / known.file, directory)):
            yield known
        else:
            logs = tuple(row.log for row in members)
            empty = FleetCalibration(robot, group, logs, key=key)
            yield _pooled(empty, members, directory, place or directory, name, allow_unusable=allow_unusable)


def groups_of(rows: Sequence[FleetLog]) -> dict[tuple[str, str], list[FleetLog]]:
    """Return the logs that could be used, by robot and group."""
    found: dict[tuple[str, str], list[FleetLog]] = {}
    for row in rows:
        if row.status != "failed":
            found.setdefault((row.robot, row.group), []).append(row)
    return dict(sorted(found.items()))


def runs_of_fleet(directory: Path) -> dict[str, list[Path]]:
    """Return the usable runs of a batch by the name of their group: of the manifest, else of the robot.

    Robots that are in the same group of the manifest are distinguished. Of copies in a group, the first one counts.

    Raises
    ------
    RunError
        The folder does not hold the result of a batch.
    """
    logs = [one for one in logs_of_fleet(directory) if one.usable]
    robots = {one.robot for one in logs}
    found: dict[str, dict[tuple[str, ...], Path]] = {}
    for one in logs:
        name = one.group if one.group and len(robots) == 1 else f"{one.robot} {one.group}".strip() or directory.name
        found.setdefault(name, {}).setdefault(_content(one.inputs), directory / one.run)
    return {name: list(runs.values()) for name, runs in found.items()}


def is_fleet(directory: Path) -> bool:
    """Return whether a folder is that of a batch."""
    return is_regular(directory / FLEET_FILE, directory)


def _pooled(
    one: FleetCalibration, members: Sequence[FleetLog], directory: Path, place: Path, name: str, *, allow_unusable: bool
) -> FleetCalibration:
    from icrtool.calibration.pooled import calibrate_runs
    from icrtool.output.run_directory import open_run
    from icrtool.output.tables.calibration import held_out_blocks
    from icrtool.output.text_blocks import format_blocks

    # A copy of a log would be tested on itself.
    distinct = {_content(row.inputs): row for row in reversed(members)}
    ordered = sorted(distinct.values(), key=lambda row: (row.start_utc, row.log))
    total_s = sum(row.duration_s or 0.0 for row in ordered)
    count = math.ceil(len(ordered) * min(1.0, MOST_POOLED_S / max(total_s, 1.0)))
    spaced = {ordered[i].log for i in np.linspace(0, len(ordered) - 1, count).round().astype(int)}
    file = f"{CALIBRATIONS}/{name}.json"
    opened: dict[str, str] = {}

    def usable() -> Iterator[Run]:
        for row in members:
            if row.log in spaced and (row.usable or allow_unusable):
                run = open_run(place / row.run)
                opened[row.log] = run.name
                yield run

    try:
        result = calibrate_runs(usable(), allow_unusable=allow_unusable)
        make_folders(directory / CALIBRATIONS, directory)
        write_calibration(result.calibration, directory / file, directory)
    except IcrToolError as err:
        left_out = tuple(log for log in one.logs if log not in opened)
        return replace(one, left_out=left_out, reason=str(err))
    numbers = result.calibration.controller
    table = format_blocks(held_out_blocks(result.table))
    reached = result.table.score("recommended").within(result.table.horizons_m, BUDGET_M)
    short = {name for name, _ in result.left_out}
    used = tuple(log for log, run_name in opened.items() if run_name not in short)
    return replace(
        one, logs=used, left_out=tuple(log for log in one.logs if log not in used), file=file,
        recommended=result.calibration.recommended, multiplier=float(numbers.multiplier),
        multiplier_std=float(numbers.multiplier_std), table=table,
        icrs_m=tuple(result.calibration.geometry[name] for name in ICR_COLUMNS),
        within_m=None if reached is None else float(reached.distance_m),
        within_beyond=reached is not None and reached.beyond,
    )  # fmt: skip


def _content(inputs: Sequence[FleetFile]) -> tuple[str, ...]:
    """Return what copies of a log have in common, whatever their names; of content that is not known, the place."""
    return tuple(sorted(file.sha256 or f"at {file.path}" for file in inputs))


def _stored(directory: Path) -> tuple[FleetCalibration, ...]:
    """Return the calibrations of an earlier batch in the same folder."""
    try:
        return read_fleet(directory).calibrations
    except (OSError, ValueError, RecursionError):
        return ()


def _file_name(robot: str, group: str, taken: set[str]) -> str:
    """Return a file name for a robot and group, distinct from those that are taken."""
    text = "-".join(part for part in (robot, group) if part) or "all"
    name = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in text)[:100].strip(".") or "all"
    return unique_name(name, taken)
