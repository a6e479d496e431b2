"""``icrtool export``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, cast

import click

from icrtool.cli.inputs import RUNS, read_calibration
from icrtool.cli.options import FILE, PLACE, choice, flag, option
from icrtool.cli.printing import Printer, write_or_print

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.output.exports.controllers import Target
    from icrtool.output.exports.paths import TrajectoryFormat
    from icrtool.records.run import Run

CONTROLLERS = ("diff_drive_controller", "clearpath", "nav2", "husarion", "json", "icr")
TRAJECTORIES = ("evo", "kitti")
TARGETS = (*CONTROLLERS, *TRAJECTORIES, "google-earth", "qgis", "foxglove")

TEXT_SUFFIXES = (".txt", ".csv")
"""Of a file for one trajectory, beside those of the formats; what else a name has after a dot is part of the name."""

ALL_THE_SAME = "--force exports it all the same"


@click.command("export")
@click.argument("source", metavar="[RUN|CAL.json]", required=False, type=PLACE)
@choice("--for target", TARGETS, "What the result is for.", required=True)
@option("-o --output", "FILE", FILE, "File to write; for evo and kitti a directory with a file for each path of the "
        "run, or a file with the suffix .tum, .kitti, .txt or .csv.")  # fmt: skip
@flag("--force", "Also export what is not fit for use.")
def command(source: Path | None, target: str, output: Path | None, force: bool) -> None:
    """Print a calibration for a robot's controller, or a run for other programs.

    CAL.json is a file that `icrtool calibrate -o` wrote. A RUN, a directory that `icrtool fit` wrote, is calibrated
    first, with the same result; without an argument, the newest run below icrtool-runs/. The covariances are measured
    on distance held out of the fit. Target icr: the whole motion model as JSON, in REP-103 (y left).

    \b
    Paths of a RUN (world ENU about the datum, body x forward and y left):
      evo, kitti    trajectories in TUM or KITTI format: FILE is the filter's; DIR also gets icr and no_slip
      google-earth  KML: paths, drive over time, outages, slip events
      qgis          GeoJSON: the same, and states and fixes with attributes
      foxglove      MCAP: odometry, fixes, ICRs, open-loop error, events; the layout is beside it

    \b
    Example:
      icrtool export --for clearpath icrtool-runs/field
      icrtool export --for icr season.json -o twist.json
      icrtool export --for evo icrtool-runs/field -o trajectories
      icrtool export --for foxglove icrtool-runs/field -o field.mcap
    """  # noqa: D301 - click reads the escape
    from icrtool.output.files.atomic import check_place

    if target in TRAJECTORIES and output is not None and not _is_one_file(output):
        _write_trajectories(_run(source), cast("TrajectoryFormat", target), output)
        return
    if target == "foxglove" and output is None:
        raise click.UsageError("an MCAP file is not text: name it with -o FILE.mcap")
    if output is not None:
        check_place(output)
    if target == "foxglove" and output is not None:
        _write_foxglove(_run(source, output), output)
        return
    if target in CONTROLLERS:
        from icrtool.output.exports.controllers import format_export

        write_or_print(f"{format_export(_calibration(source, force=force), cast('Target', target))}\n", output)
    else:
        write_or_print(_path_text(_run(source, output), target), output)


def _is_one_file(output: Path) -> bool:
    """Return whether a place for trajectories is a file: by what is there, else by a suffix that such files have."""
    from icrtool.output.exports.paths import SUFFIXES

    return output.is_file() or (output.suffix.lower() in (*SUFFIXES.values(), *TEXT_SUFFIXES) and not output.is_dir())


def _path_text(run: Run, target: str) -> str:
    """Return the paths of a run in a text format."""
    if target in TRAJECTORIES:
        from icrtool.output.exports.paths import format_trajectory, paths_of

        return format_trajectory(paths_of(run)[0], cast("TrajectoryFormat", target))
    if target == "qgis":
        from icrtool.output.exports.maps import format_geojson

        return f"{format_geojson(run)}\n"
    from icrtool.output.exports.maps import format_kml

    return f"{format_kml(run)}\n"


def _write_trajectories(run: Run, target: TrajectoryFormat, directory: Path) -> None:
    """Write a file for each path of a run."""
    from icrtool.output.exports.paths import SUFFIXES, format_trajectory, is_trajectory, paths_of

    directory.mkdir(parents=True, exist_ok=True)
    from icrtool.output.files.atomic import check_place, write_file

    files = {directory / f"{path.name}{SUFFIXES[target]}": path for path in paths_of(run)}
    for file in files:
        check_place(file, directory, is_trajectory)
    for file, path in files.items():
        write_file(file, format_trajectory(path, target), directory, is_trajectory)
        click.echo(f"written to {file}")


def _write_foxglove(run: Run, output: Path) -> None:
    """Write the MCAP file, and the layout beside it."""
    from icrtool.output.exports.foxglove import foxglove_layout, is_layout, write_foxglove
    from icrtool.output.files.atomic import atomic_file, check_place, write_file
    from icrtool.output.files.formats import json_bytes

    layout = output.with_name(f"{output.stem}.layout.json")
    check_place(layout, layout.parent, is_layout)
    with atomic_file(output) as partial:
        write_foxglove(run, partial)
    write_file(layout, json_bytes(foxglove_layout(run)), layout.parent, is_layout)
    click.echo(f"written to {output}; layout for Foxglove: {layout}")


def _run(source: Path | None, output: Path | None = None) -> Run:
    """Read the run whose paths are asked for; one that is not usable has them too. Its log is never the output."""
    from icrtool.errors import OutputError, RunError
    from icrtool.output.run_directory import newest_run, open_run

    if source is not None and source.is_file():
        raise RunError(source, "is a file, and paths come from a run", "name a directory that icrtool fit wrote")
    run = open_run(source or newest_run(RUNS))
    if output is not None and output.resolve() in (Path(file.path).resolve() for file in run.document.inputs):
        raise OutputError(output, "is the log that the run was made from", "name another file")
    if not run.usable:
        Printer().warn([f"{run.name}: its ICRs are not usable: {run.document.unusable_because}"])
    return run


def _calibration(source: Path | None, *, force: bool) -> Calibration:
    """Read a calibration file, or calibrate from a run; one that is not fit for use is refused without `force`."""
    from icrtool.calibration.record import unfit_reasons
    from icrtool.errors import DataError

    name, found = read_calibration(source, force=force, advice=f"; {ALL_THE_SAME}")
    if (reasons := unfit_reasons(found)) and not force:
        raise DataError(name, f"not fit for use: {reasons[0]}", f"calibrate with other logs; {ALL_THE_SAME}")
    return found
