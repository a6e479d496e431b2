"""From a log to its run directory, and from a run to its dropout report: the work of fit, dropout-report and batch."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from icrtool.records.late_output import FigureSet

if TYPE_CHECKING:
    from icrtool.config import Config
    from icrtool.dropout_analysis.baseline import BaselineReport
    from icrtool.dropout_analysis.report import DropoutReport
    from icrtool.dropout_analysis.trials import ErrorSink
    from icrtool.records.run import Run, WarmStart

Stage = Callable[[str], None]
"""Called with what is done next."""


@dataclass(frozen=True, slots=True)
class ReportOptions:
    """What is asked of a dropout report, the same for one log and for many.

    Attributes
    ----------
    plots : formats of the pictures
    figures : ``all``: those of the paper too
    ladder : compare all models on distance that they were not fitted to
    strict : as in `icrtool.dropout_report`
    page : write report.html
    allow_unusable : as in `icrtool.dropout_report`
    """

    plots: tuple[str, ...] = ("png",)
    gates: tuple[str, ...] = ()
    budgets_m: tuple[float, ...] = (0.5,)
    ladder: bool = True
    strict: bool = False
    page: bool = True
    allow_unusable: bool = False
    figures: FigureSet = "default"


def fit_and_write(
    log: Path,
    directory: Path,
    config: Config,
    begin: Stage,
    *,
    overwrite: bool = False,
    plots: tuple[str, ...] = ("png",),
    figures: FigureSet = "default",
    states: Literal["csv", "parquet"] | None = None,
    span: tuple[str | None, str | None] = (None, None),
    warm_start: WarmStart | None = None,
    changes_s: tuple[float, ...] = (),
    smooth: bool = False,
    share: Callable[[float], None] | None = None,
    note: Callable[[str], None] | None = None,
    inside: Path | None = None,
    then: Callable[[Run, Path], None] | None = None,
) -> Run:
    """Fit a log and write its run directory.

    Parameters
    ----------
    overwrite : the run of another recording may be replaced
    plots, figures, states, note, inside : as in `icrtool.output.run_directory.write_run`
    span : from when to when the log is read, as in `icrtool.read_log`
    warm_start, changes_s, smooth : as in `icrtool.fit`
    share : called with the share of the log that was read
    then : called with the run and its new directory before that is put in place: writes what belongs to the result
    """
    from icrtool.output.run_directory import check_target, replaced_log, write_run

    check_target(directory, log, overwrite=overwrite, inside=inside)
    begin("reading")
    from icrtool.logs.read_log import read_log

    logs = [read_log(log, config, share, start=span[0], end=span[1])]
    from icrtool.calibration.fit import fit

    # The callee alone holds the log, and frees its columns where they are needed no longer.
    run = fit(logs.pop(), config, warm_start=warm_start, changes_s=changes_s, smooth=smooth, watch=begin)
    if note is not None and (before := replaced_log(directory, run)) is not None:
        note(f"{directory}: replaced the run of another recording ({before})")
    begin("writing, pictures" if plots else "writing")
    more = partial(then, run) if then is not None else None
    write_run(run, directory, states=states, plots=plots, figures=figures, note=note, inside=inside, then=more)
    return run


def report_and_write(
    run: Run,
    directory: Path,
    options: ReportOptions,
    begin: Stage,
    *,
    baseline: BaselineReport | None,
    further: Mapping[str, Any] | None = None,
    trials: bool = False,
) -> DropoutReport:
    """Analyse a run and write its dropout report, and its page, into its directory.

    Parameters
    ----------
    baseline : earlier report of the same log
    further : arguments of `icrtool.dropout_report`
    trials : write every single trial to trials.parquet
    """
    from icrtool.dropout_analysis.dropout_report import dropout_report
    from icrtool.output.dropout_directory import DROPOUT_DIRECTORY, write_report
    from icrtool.output.run_directory import PAGE_FILE

    def analysed(sink: ErrorSink | None) -> DropoutReport:
        begin("dropout analysis")
        report = dropout_report(
            run, budgets_m=options.budgets_m, gates=options.gates, comparison=options.ladder, baseline=baseline,
            strict=options.strict, allow_unusable=options.allow_unusable, sink=sink, **(further or {}),
        )  # fmt: skip
        begin("dropout report, pictures" if options.plots else "dropout report")
        return report

    stamps = run.table.stamp_ns if trials else None
    report = write_report(
        analysed, directory / DROPOUT_DIRECTORY, plots=options.plots, figures=options.figures, stamp_ns=stamps,
        inside=directory,
    )  # fmt: skip
    if options.page:
        from icrtool.output.page.run_page import write_page

        begin("page")
        write_page(run, report, directory / PAGE_FILE, plots=directory, inside=directory)
    return report
