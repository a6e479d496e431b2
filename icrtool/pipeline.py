"""The work on one log: from the log to its run, and from the run to its dropout report.

`fit_log` works in memory, for `icrtool.fit` and ``icrtool info``. `fit_into` and `report_into` read the log from its
file and write directories, for ``icrtool fit``, ``dropout-report`` and ``batch``. A request reaches the code that acts
on it unchanged. Between two stages freed memory is given back.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from icrtool.config import Config
from icrtool.records.places import Below, Place, path_of
from icrtool.records.process_resources import give_back_freed
from icrtool.records.requests import FitRequest, ReportRequest, ResultFiles
from icrtool.records.run import Run, WarmStart, check_type
from icrtool.records.stages import Watch, unwatched
from icrtool.records.tables import RobotLog

if TYPE_CHECKING:
    from icrtool.calibration.record import Calibration
    from icrtool.dropout_analysis.report import BaselineReport, DropoutReport
    from icrtool.dropout_analysis.trials import ErrorSink


def fit(
    log: RobotLog,
    config: Config | None = None,
    *,
    changes_s: tuple[float, ...] = (),
    smooth: bool = False,
    warm_start: WarmStart | None = None,
    watch: Watch = unwatched,
) -> Run:
    """Learn a robot's track ICRs from a log, and its motion model.

    Parameters
    ----------
    log : as `icrtool.read_log` returns it
    config : default: all defaults
    changes_s, smooth : the fields of `icrtool.records.requests.FitRequest`
    warm_start, watch : as in `fit_log`

    Returns
    -------
    Run
        The run; no file is written. Its `document` holds the motion model that `icrtool.calibrate` fits, the ICRs, and
        the numbers for a controller.

    Raises
    ------
    DataError
        Streams that cannot be used together, or hold values that are not finite numbers.
    ConfigError
        A start that preset ``field`` does not take.
    """
    check_type(log, RobotLog, "icrtool.read_log(path, config) reads one")
    request = FitRequest(changes_s=tuple(changes_s), smooth=smooth)
    # Only the called function holds the log, so that it can free the columns.
    held = [log]
    del log
    config = config if config is not None else Config()
    return fit_log(held.pop(), config, request, warm_start=warm_start, watch=watch)


def fit_log(
    log: RobotLog,
    config: Config,
    request: FitRequest,
    *,
    warm_start: WarmStart | None = None,
    watch: Watch = unwatched,
) -> Run:
    """Return the run of a log, with its motion model.

    Parameters
    ----------
    warm_start : final ICRs of another run with their covariance (Fig. 18), in place of the preset's start
    watch : called with the name of each stage when it begins

    Raises
    ------
    DataError, ConfigError
        As of `fit`.
    """
    from icrtool.calibration.run_models import with_motion
    from icrtool.estimation.fit import fit_filter

    watch, held = _giving_back(watch), [log]
    del log
    run = fit_filter(held.pop(), config, request, warm_start=warm_start, watch=watch)
    watch("motion model")
    return replace(run, document=with_motion(run))


def _giving_back(watch: Watch) -> Watch:
    """Return a function that gives back freed memory at the start of each stage, and then calls `watch`."""

    def begin(stage: str) -> None:
        give_back_freed()
        watch(stage)

    return begin


@contextmanager
def fit_into(
    directory: Place,
    log: Path,
    config: Config,
    request: FitRequest,
    files: ResultFiles,
    watch: Watch,
    *,
    warm_start: Path | None = None,
    share: Callable[[float], None] | None = None,
    note: Callable[[str], None] | None = None,
) -> Iterator[tuple[Run, Path]]:
    """Fit a log, and yield its run and the new directory, which is put in place at the end of the block.

    Parameters
    ----------
    directory : of the run; may be at an address, as `icrtool.output.files.remote_place.folder_on_disk` takes it
    warm_start : run or calibration file to start from
    share : called with the share of the log that was read
    note : as in `icrtool.output.run_directory.new_run`
    """
    from icrtool.logs.read_log import read_log
    from icrtool.output.files.remote_place import folder_on_disk
    from icrtool.output.run_directory import check_target, new_run, replaced_log

    start, watch = _warm_start(warm_start, config, note), _giving_back(watch)
    path = path_of(directory)
    with folder_on_disk(path, begin=watch) as on_this_disk:
        place = directory if on_this_disk is path else on_this_disk
        check_target(place, log, overwrite=files.overwrite)
        watch("reading")
        # No name here holds the log: its columns are freed where they are needed no longer.
        run = fit_log(
            read_log(log, config, share, start=request.start, end=request.end), config, request,
            warm_start=start, watch=watch,
        )  # fmt: skip
        if note is not None and (before := replaced_log(on_this_disk, run)) is not None:
            note(f"{path}: replaced the run of another recording ({before})")
        watch("writing")
        with new_run(
            run, place, states=files.states, plots=files.plots, figures=files.figures, note=note, watch=watch,
        ) as partial:  # fmt: skip
            yield run, partial


def _warm_start(source: Path | None, config: Config, note: Callable[[str], None] | None) -> WarmStart | None:
    """Return the final ICRs of a run, or the ICRs of a calibration file; note where its track width differs."""
    if source is None:
        return None
    from icrtool.output.files.formats import open_calibration
    from icrtool.output.run_directory import open_run

    start = open_calibration(source).warm_start() if source.is_file() else open_run(source).ended_with
    start = replace(start, source=source.name)
    theirs, ours = start.track_width_m, config.robot.track_width_m
    if note is not None and theirs is not None and ours is not None and not math.isclose(theirs, ours, rel_tol=0.01):
        note(f"{source}: made with a track width of {theirs:g} m, not {ours:g} m: are its ICRs this robot's?")
    return start


def report_into(
    directory: Path,
    run: Run,
    request: ReportRequest,
    files: ResultFiles,
    watch: Watch,
    *,
    log: Path | None = None,
    calibrations: Sequence[Calibration] = (),
    baseline: BaselineReport | None = None,
) -> DropoutReport:
    """Report on a run, and write the report and its page into the run's directory.

    Parameters
    ----------
    log : that scored topics are read from
    calibrations : each becomes a row of the report
    baseline : of the same log
    """
    from icrtool.dropout_analysis.dropout_report import report_on
    from icrtool.output.dropout_directory import DROPOUT_DIRECTORY, write_report
    from icrtool.output.run_directory import PAGE_FILE

    watch = _giving_back(watch)

    def analysed(sink: ErrorSink | None) -> DropoutReport:
        report = report_on(run, request, log=log, calibrations=calibrations, baseline=baseline, sink=sink, watch=watch)
        watch("dropout report")
        return report

    stamps = run.table.stamp_ns if files.trials else None
    report = write_report(
        analysed, Below(directory, DROPOUT_DIRECTORY), plots=files.plots, figures=files.figures, stamp_ns=stamps,
        watch=watch,
    )  # fmt: skip
    if files.page:
        from icrtool.output.page.pages import write_page

        watch("page")
        write_page(run, report, Below(directory, PAGE_FILE), plots=directory)
    return report
