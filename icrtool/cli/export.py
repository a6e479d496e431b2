"""``icrtool export``, which writes results for other programs."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, cast, get_args

import click

from icrtool.cli import lazy_imports
from icrtool.cli.inputs import RUNS_FOLDER, is_log, read_calibration_and_run
from icrtool.cli.options import FILE, PLACE, choice, flag, option
from icrtool.cli.printing import Printer, write_or_print
from icrtool.records.choices import ControllerTarget, TrajectoryFormat
from icrtool.records.places import Below
from icrtool.records.text import escaped

with lazy_imports():
    from icrtool import errors
    from icrtool.calibration import localization, record
    from icrtool.output import run_directory
    from icrtool.output.exports import controllers, foxglove, paths
    from icrtool.output.exports import localization as localization_file
    from icrtool.output.files import atomic, formats

if TYPE_CHECKING:
    from icrtool.records.run import Run

CONTROLLERS, TRAJECTORIES = get_args(ControllerTarget), get_args(TrajectoryFormat)
LOCALIZATION = "robot_localization"
EXPORT_TARGETS = (*CONTROLLERS, LOCALIZATION, *TRAJECTORIES, "google-earth", "qgis", "foxglove")
"""Values of --for: the programs that results are exported for."""

TEXT_SUFFIXES = (".txt", ".csv")
"""Suffixes of a file with one trajectory, in addition to the suffixes of the formats. A path with any other suffix is a
folder."""

_EXAMPLE_COMMANDS = (
    ("a controller", "diff_drive_controller", "clearpath, nav2, husarion", False),
    ("a filter", LOCALIZATION, "", False),
    ("your own node", "icr", "json", False),
    ("evaluation", "evo -o paths", "kitti", True),
    ("a map", "qgis -o map.geojson", "google-earth", True),
    ("a viewer", "foxglove -o view.mcap", "", True),
)
"""Uses of an export: words for the use, target with options, further targets, and whether the target needs a run."""

FORCE_ADVICE = "--force exports it nevertheless"
"""Advice in errors about results that are not fit for use."""


@click.command("export")
@click.argument("source", metavar="[RUN|CAL.json]", required=False, type=PLACE)
@choice("--for target", EXPORT_TARGETS, "Program that the result is for; without it, example commands are listed.")
@option("-o --output", "FILE", FILE, "File to write; for evo and kitti: a folder for a file of each path of the "
        "run, or a file with the suffix .tum, .kitti, .txt or .csv.")  # fmt: skip
@flag("--force", "Also export a result that is not fit for use.")
def export_command(source: Path | None, target: str | None, output: Path | None, force: bool) -> None:
    """Print a calibration for a controller, or a run for other programs.

    CAL.json is a file that `icrtool calibrate -o` wrote. A RUN is a directory that `icrtool fit` wrote; it is
    calibrated first, with the same result. Without an argument, the newest run below icrtool-runs/ is used. The
    covariances are measured on distance held out of the fit. Target icr writes the whole motion model as JSON, in
    REP-103 (y left).

    Target robot_localization writes ekf.yaml: parameters of the filter and of navsat_transform_node, and covariances
    of wheel odometry and IMU, each with its source and standard deviation. For a CAL.json it writes the covariances
    alone.

    \b
    Paths of a RUN (world ENU about the datum, body x forward and y left):
      evo, kitti    trajectories in TUM or KITTI format: FILE of the filter; DIR also of icr and no_slip
      google-earth  KML: paths, drive over time, outages, slip events
      qgis          GeoJSON: the same as KML, and states and fixes with attributes
      foxglove      MCAP: odometry, fixes, ICRs, open-loop error, events; and a layout file

    \b
    Example:
      icrtool export --for clearpath icrtool-runs/field
      icrtool export --for icr season.json -o twist.json
      icrtool export --for robot_localization icrtool-runs/field -o ekf.yaml
      icrtool export --for evo icrtool-runs/field -o trajectories
      icrtool export --for foxglove icrtool-runs/field -o field.mcap
    """  # noqa: D301 - click reads the escape
    target = _checked_target(target, source, output)
    if target in TRAJECTORIES and output is not None:
        # An existing place decides between file and folder; for a new place the suffix decides.
        suffixes = (*paths.SUFFIXES.values(), *TEXT_SUFFIXES)
        if not (output.is_file() or (output.suffix.lower() in suffixes and not output.is_dir())):
            _write_trajectories(_run_to_export(source), cast(TrajectoryFormat, target), output)
            return
    if output is not None:
        atomic.check_place(output)
    if target in CONTROLLERS or target == LOCALIZATION:
        name, calibration, run = read_calibration_and_run(source, force=force, advice=f"; {FORCE_ADVICE}")
        if (reasons := record.unfit_reasons(calibration)) and not force:
            advice = f"calibrate with other logs; {FORCE_ADVICE}"
            raise errors.DataError(name, f"not fit for use: {reasons[0].text}", advice)
        if target == LOCALIZATION:
            text = localization_file.format_localization(calibration, localization.localization(calibration, run))
        else:
            text = controllers.format_export(calibration, cast(ControllerTarget, target))
    else:
        run = _run_to_export(source, output)
        if target == "foxglove" and output is not None:
            _write_foxglove(run, output)
            return
        if target in TRAJECTORIES:
            text = paths.format_trajectory(paths.paths_of(run)[0], cast(TrajectoryFormat, target))
        else:
            text = paths.format_geojson(run) if target == "qgis" else paths.format_kml(run)
    write_or_print(text if target in TRAJECTORIES else f"{text}\n", output)


def _checked_target(target: str | None, source: Path | None, output: Path | None) -> str:
    """Return the target; refuse a missing target, and a binary target without an output file."""
    if target is None:
        raise click.UsageError(_example_commands(source))
    if target == "foxglove" and output is None:
        raise click.UsageError("an MCAP file cannot be printed: name a file with -o FILE.mcap")
    return target


def _example_commands(source: Path | None) -> str:
    """Return an example command for each use of an export; for a calibration, only uses that need no run."""
    name = "RUN" if source is None else shlex.quote(escaped(str(source)))
    has_paths = source is None or source.is_dir()
    lines = [
        f"  {user:15} icrtool export --for {first} {name}{f'   # also {others}' if others else ''}"
        for user, first, others, paths_only in _EXAMPLE_COMMANDS
        if has_paths or not paths_only
    ]
    return "\n".join(["--for is missing: what is the export for?", *lines])


def _write_trajectories(run: Run, target: TrajectoryFormat, directory: Path) -> None:
    """Write a file for each path of a run into a folder, and print the names of the files."""
    directory.mkdir(parents=True, exist_ok=True)
    files = {Below(directory, f"{path.name}{paths.SUFFIXES[target]}"): path for path in paths.paths_of(run)}
    for file in files:
        atomic.check_place(file, paths.is_trajectory)
    for file, path in files.items():
        atomic.write_file(file, paths.format_trajectory(path, target), paths.is_trajectory)
        click.echo(f"written to {file.path}")


def _write_foxglove(run: Run, output: Path) -> None:
    """Write the MCAP file of a run, and the layout into the same folder; print both names."""
    layout = Below(output.parent, f"{output.stem}.layout.json")
    atomic.check_place(layout, foxglove.is_layout)
    with atomic.atomic_file(output) as partial:
        foxglove.write_foxglove(run, partial)
    content = formats.json_bytes(foxglove.foxglove_layout(run))
    atomic.write_file(layout, content, foxglove.is_layout)
    click.echo(f"written to {output}; layout for Foxglove: {layout.path}")


def _run_to_export(source: Path | None, output: Path | None = None) -> Run:
    """Return the run whose paths are exported, even if it is not usable; refuse its log as the output."""
    if source is not None and is_log(source):
        advice = f"icrtool fit {escaped(str(source))} makes its run"
        raise errors.RunError(source, "is a log, and paths come from a run", advice)
    if source is not None and source.is_file():
        advice = "name a directory that icrtool fit wrote"
        raise errors.RunError(source, "is a file, and paths come from a run", advice)
    run = run_directory.open_run(source or run_directory.newest_run(RUNS_FOLDER))
    if output is not None and output.resolve() in (Path(file.path).resolve() for file in run.document.inputs):
        raise errors.OutputError(output, "is the log that the run was made from", "name another file")
    if not run.usable:
        Printer().warn([f"{run.name}: its ICRs are not usable: {run.document.unusable_because}"])
    return run
