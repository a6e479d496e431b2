"""A finished run as the source of a dropout report: which one, with what configuration, from which log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from icrtool.config import Config, parse_config
from icrtool.dropout_analysis.smoothed_reference import held_against
from icrtool.errors import ConfigError, RunError
from icrtool.output.run_directory import RUN_FILE, StoredRun, is_run_directory, read_run, read_smoothed
from icrtool.records.run import DrivenRun

if TYPE_CHECKING:
    from icrtool.estimation.filter_setup import WarmStart
    from icrtool.estimation.fit import FilterRun
    from icrtool.records.tables import RobotLog

SAME_STATE_M = 1e-6
"""States made again on another machine may differ by rounding, not by this much."""


def read_source(directory: Path) -> StoredRun:
    """Read a run; what reading it took beyond the states goes back to the system.

    Raises
    ------
    RunError
        As `read_run`.
    """
    import pyarrow as pa

    run = read_run(directory)
    pa.default_memory_pool().release_unused()
    return run


def stored_config(run: StoredRun) -> Config:
    """Return the configuration a run was made with.

    Raises
    ------
    RunError
        It is not one that this version knows.
    """
    try:
        return parse_config(run.summary["config"])
    except ConfigError as err:
        raise RunError(run.directory, f"its configuration is not ours ({err.what})", "run icrtool fit again") from err


def judged_run(run: StoredRun | FilterRun, directory: Path) -> DrivenRun:
    """Return a run held against the smoother's states in its directory.

    Raises
    ------
    RunError
        It has none.
    """
    return held_against(run, read_smoothed(directory, run.table.stamp_ns))


def log_of(run: StoredRun) -> Path:
    """Return the log a run was made from: its file, or the bag directory its files lie in.

    Raises
    ------
    RunError
        It is not where it was when the run was made.
    """
    files = [Path(file["path"]) for file in run.summary["inputs"]]
    gone = [file for file in files if not file.is_file()]
    if gone or not files:
        what = gone[0] if gone else "a list of inputs"
        advice = "forced outages need the measurements: put the log back, or fit it where it is now"
        raise RunError(run.directory, f"the log it was made from is gone ({what})", advice)
    folder = files[0].parent
    packed = files[0].suffix in {".zstd", ".zst"}
    return folder if len(files) > 1 or packed or (folder / "metadata.yaml").is_file() else files[0]


def check_same_log(run: StoredRun, log: RobotLog) -> None:
    """Refuse a log that is not the one a run was made from.

    Raises
    ------
    RunError
        Its files have another size or content.
    """
    stored = sorted((file["bytes"], file["sha256"]) for file in run.summary["inputs"])
    if stored != sorted((file.bytes, file.sha256) for file in log.inputs):
        why = f"the log it was made from has changed since ({', '.join(file.path for file in log.inputs)})"
        raise RunError(run.directory, why, "run icrtool fit again")


def check_same_states(run: StoredRun, again: FilterRun) -> None:
    """Refuse a run whose log and configuration give other states today.

    Raises
    ------
    RunError
        They do: another version of icrtool made the run.
    """
    ours, theirs = run.table, again.table
    same = np.array_equal(ours.stamp_ns, theirs.stamp_ns) and all(
        np.allclose(getattr(ours, column), getattr(theirs, column), rtol=0.0, atol=SAME_STATE_M)
        for column in ("north_m", "east_m", "y_icr_right_m", "y_icr_left_m", "x_icr_m")
    )
    if not same:
        why = f"its log gives other states now (icrtool {run.summary['tool_version']} made it)"
        raise RunError(run.directory, why, "forced outages need a run that can be made again: fit the log again")


def terrain_changes_s(run: StoredRun) -> tuple[float, ...]:
    """Return the terrain changes [s] that a run was made with."""
    return tuple(float(segment["begin_s"]) for segment in run.summary.get("segments", [])[1:])


def warm_start_of(run: StoredRun) -> WarmStart | None:
    """Return what a run began with, where that was another run's end.

    Raises
    ------
    RunError
        It is not readable.
    """
    from icrtool.estimation.filter_setup import WarmStart

    stored = run.summary["filter"].get("warm_start")
    if stored is None:
        return None
    try:
        icrs, covariance = np.array(stored["icrs_m"], np.float64), np.array(stored["covariance_m2"], np.float64)
        return WarmStart(icrs.reshape(3), covariance.reshape(3, 3))
    except (KeyError, TypeError, ValueError) as err:
        raise RunError(run.directory, "does not say what it was warm-started with", "run icrtool fit again") from err


def newest_run(runs: Path) -> Path:
    """Return the newest run directory below a folder, by the time of its run.json.

    Raises
    ------
    RunError
        There is none.
    """
    found = [file for file in runs.glob(f"*/{RUN_FILE}") if is_run_directory(file.parent)]
    if not found:
        raise RunError(runs, "no run in it", "name a run directory or a log, or make a run with icrtool fit")
    return max(found, key=lambda file: (file.stat().st_mtime_ns, str(file))).parent
