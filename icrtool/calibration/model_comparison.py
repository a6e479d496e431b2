"""The models of one run, each tested on distance it was not fitted to, all in the same trials.

What is fitted is fitted on windows that keep clear of the trials that it is tested in (`icrtool.calibration.held_out`);
the filter's own ICRs, momentary and final, stand beside.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from icrtool.calibration.from_runs import robot_of, use_warnings
from icrtool.calibration.held_out import HORIZONS_M, HeldOut, hold_out
from icrtool.calibration.pooled import ErrorsOf, calibration_from, held_out_predictor
from icrtool.calibration.record import Calibration
from icrtool.calibration.run_recording import recording_of, scaled_gyro, with_turn_rate
from icrtool.kernels.arrays import Complexes, Floats
from icrtool.kernels.equal_steps import ROWS_AT_ONCE
from icrtool.kernels.open_loop.error_statistics import error_summary
from icrtool.kernels.open_loop.prefix_sums import open_loop_errors
from icrtool.kernels.open_loop.trials import Drive, FrozenIcrs, Summary
from icrtool.motion.models import FittedModel
from icrtool.motion.recording import Recording
from icrtool.motion.trials import Trials
from icrtool.records.dropout import MeasuredHeading, ModelScore
from icrtool.records.memory import give_back_freed
from icrtool.records.run import Run, width_or_usual_m

FAMILY = {"no_slip": "no_slip", "multiplier": "multiplier", "window": "icr", "extended": "recommended"}
"""Names of the table's rows (public) and of the models of the family that they are."""

ROWS = {of: row for row, of in FAMILY.items()}

MODELS = ("no_slip", "multiplier", "icr", "icr_final", "window", "extended")
"""In the order of the table. Each but the multiplier may come again with a measured heading, ``_gyro`` or ``_heading``
behind its name."""

LABELS = {
    "no_slip": "no slip", "multiplier": "best multiplier", "icr": "ICR, momentary", "icr_final": "ICR, final",
    "window": "window fit", "extended": "extended",
}  # fmt: skip
FITTED_TO = {
    "no_slip": "never", "multiplier": "others", "icr": "before", "icr_final": "all", "window": "others",
    "extended": "others",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ModelComparison:
    """The table.

    Attributes
    ----------
    blocks : of distance, by which a model is chosen
    starts : trials start from so many states
    chosen : name of the model of the family chosen for each block, without it
    fits : of all windows, by name in the family: what to use, not what was tested
    best : the model recommended for the whole log
    width_m : track width b, or what stands for it
    heading : what the rows with a measured heading go by, ``gyro`` or ``heading``; empty without
    notes : what was left out of the table and why, and what was corrected
    calibration : what ``icrtool calibrate`` gives for this run alone; None where the track width is not known
    """

    horizons_m: tuple[float, ...]
    blocks: int
    starts: int
    scores: tuple[ModelScore, ...]
    chosen: tuple[str, ...]
    fits: dict[str, FittedModel]
    best: str
    width_m: float
    heading: str
    notes: tuple[str, ...]
    calibration: Calibration | None

    @property
    def summaries(self) -> dict[str, Summary]:
        """The errors of each row, by its name."""
        return {score.name: score.summary for score in self.scores}

    def score(self, name: str) -> ModelScore:
        """Return a score by name."""
        return next(score for score in self.scores if score.name == name)


class ComparedModels(NamedTuple):
    """The table, what gives the errors of the recommended model in any trials, and the run's drive."""

    table: ModelComparison
    recommended: ErrorsOf
    drive: Drive


def compare_models(run: Run, headings: Iterable[MeasuredHeading] = ()) -> ComparedModels:
    """Test every model on distance it was not fitted to.

    Parameters
    ----------
    run : a finished run, or one read back
    headings : measured headings, best first, for the models that need not turn by wheels alone

    Raises
    ------
    DataError
        The drive is too short to hold anything out.

    Notes
    -----
    Cross-validation (Stone 1974; see `icrtool.calibration.held_out` for what is left out of a trial's fit). The
    filter's momentary ICRs know the drive up to the start, its final ones all of it.
    """
    recording, heading, notes = _with_heading(run, headings)
    wheels, turned = hold_out([recording])
    give_back_freed()
    (trials,) = wheels.trials
    scores = list(_wheels_scores(run, recording, trials, wheels))
    if turned is not None:
        scores += _turned_scores(run, recording, trials, turned, heading)
    table = ModelComparison(
        horizons_m=HORIZONS_M,
        blocks=len(wheels.folds),
        starts=int(np.count_nonzero((trials.ends >= 0).any(axis=1))),
        scores=tuple(scores),
        chosen=wheels.chosen,
        fits={name: fit.fitted for name, fit in (wheels.fits | (turned.fits if turned else {})).items()},
        best=wheels.recommended,
        width_m=recording.width_m,
        heading=heading,
        notes=notes,
        calibration=_calibration(run, recording, wheels, turned if heading == "gyro" else None),
    )
    drive = recording.drive._replace(v_left=run.table.v_left_mps, v_right=run.table.v_right_mps)
    return ComparedModels(table, held_out_predictor([recording], wheels, 0), drive)


def _calibration(run: Run, recording: Recording, wheels: HeldOut, gyro: HeldOut | None) -> Calibration | None:
    """Return the calibration of a run from the tables that compare its models."""
    if run.track_width_m is None:
        return None
    found = calibration_from([recording], wheels, gyro, robot_of(run))
    return replace(found, warnings=use_warnings(run))


def _with_heading(run: Run, headings: Iterable[MeasuredHeading]) -> tuple[Recording, str, tuple[str, ...]]:
    """Return the recording with the first measured heading that turns with the robot, its kind, and notes."""
    notes = []
    plain = recording_of(run, width_m=width_or_usual_m(run.track_width_m))
    for one in headings:
        found = with_turn_rate(plain, one)
        if found.gyro_radps is not None:
            if found.gyro_reversed:
                notes.append(f"the {one.kind} counts turns in the other direction: its sign was changed")
            return found, one.kind, tuple(notes)
        notes.append(f"the {one.kind} does not turn with the robot: rows with it are left out")
    if not notes:
        notes.append("the run holds no heading measured apart from the position: no rows with one")
    return plain, "", tuple(notes)


def _icrs_of(run: Run, name: str) -> FrozenIcrs:
    """Return the filter's ICRs, momentary or final."""
    if name == "icr":
        return FrozenIcrs(run.table.y_icr_right_m, run.table.y_icr_left_m, run.table.x_icr_m)
    return FrozenIcrs.constant(*run.table.icrs_at(-1))


def _wheels_scores(run: Run, recording: Recording, trials: Trials, table: HeldOut) -> Iterator[ModelScore]:
    for name in MODELS:
        if name in FAMILY:
            if name == "no_slip" and run.track_width_m is None:
                continue
            summary = table.score(FAMILY[name]).together
        else:
            # the filter's ICRs are those of the speeds that it saw
            drive = recording.drive._replace(v_left=run.table.v_left_mps, v_right=run.table.v_right_mps)
            summary = error_summary(_errors_of_filter(drive, _icrs_of(run, name), trials))
        yield ModelScore(name, LABELS[name], FITTED_TO[name], False, summary)


def _errors_of_filter(drive: Drive, icrs: FrozenIcrs, trials: Trials) -> Floats:
    """Return the errors (k, h) [m] of the filter's ICRs, some starts at a time."""
    order = np.argsort(trials.starts, kind="stable")
    starts, errors = trials.starts[order], np.empty(trials.ends.shape)
    for lo in range(0, len(drive.distance), ROWS_AT_ONCE):
        hi = min(lo + ROWS_AT_ONCE, len(drive.distance))
        some = slice(*np.searchsorted(starts, [lo, hi]))
        ends = np.full((hi - lo, trials.ends.shape[1]), -1, np.int64)
        ends[starts[some] - lo] = trials.ends[order[some]]
        errors[order[some]] = open_loop_errors(drive, icrs, ends, lo)[starts[some] - lo]
    return errors


def _turned_scores(
    run: Run, recording: Recording, trials: Trials, table: HeldOut, kind: str
) -> Iterator[ModelScore]:  # fmt: skip
    """Yield the models that turn by wheels and a measured heading; a multiplier alone gives no path."""
    path = turned_path(run, recording)
    for name in MODELS:
        if name == "multiplier" or (name == "no_slip" and run.track_width_m is None):
            continue
        if name in FAMILY:
            of = FAMILY[name]
            summary = table.score(of if of == "recommended" else f"{of}_gyro").together
        else:
            summary = error_summary(_errors_along(path, recording.drive, trials, _icrs_of(run, name)))
        yield ModelScore(f"{name}_{kind}", f"{LABELS[name]} + {kind}", FITTED_TO[name], True, summary)


def turned_path(run: Run, recording: Recording) -> tuple[Floats, Complexes]:
    """Return heading [rad] and place, ahead + j right [m], (n,) each, by mean track speed and measured turn rate."""
    psi, last = recording.cumulate(scaled_gyro(recording)), len(recording.t_s) - 1
    give_back_freed()
    held, place = recording.held_s, np.zeros(last + 1, np.complex128)
    for lo in range(0, last, ROWS_AT_ONCE):
        hi = min(lo + ROWS_AT_ONCE, last)
        moved = held[lo:hi] * (run.table.v_left_mps[lo:hi] + run.table.v_right_mps[lo:hi]) / 2.0
        place[lo + 1 : hi + 1] = moved * np.exp(0.5j * (psi[lo:hi] + psi[lo + 1 : hi + 1]))
    return psi, np.cumsum(place, out=place)


def _errors_along(path: tuple[Floats, Complexes], drive: Drive, trials: Trials, icrs: FrozenIcrs) -> Floats:
    """Return the errors (k, h) [m] of ICRs (n,) or (1,) along the path of `turned_path`.

    Notes
    -----
    With omega measured, displacement is the sum of V e^{j psi}, V the mean track speed, and
    ((y_r + y_l) / 2 - j x) (e^{j psi_e} - e^{j psi_s}) / j: W drops out.
    """
    psi, place = path
    errors: Floats = np.full(trials.ends.shape, np.nan)
    for h in range(trials.ends.shape[1]):
        some = trials.ends[:, h] >= 0
        s, e = trials.starts[some], trials.ends[some, h]
        right, left, x = (column if len(column) == 1 else column[s] for column in icrs)
        arm = (right + left) / 2.0 - 1j * x
        moved = place[e] - place[s] - 1j * arm * (np.exp(1j * psi[e]) - np.exp(1j * psi[s]))
        driven = drive.north[e] - drive.north[s] + 1j * (drive.east[e] - drive.east[s])
        errors[some, h] = np.abs(np.exp(1j * (drive.heading[s] - psi[s])) * moved - driven)
    return errors
