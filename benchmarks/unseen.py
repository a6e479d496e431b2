"""Score `icrtool.fit` without options on logs that nobody tuned for: right, hedged or wrong, by trouble.

    python benchmarks/unseen.py --drives build/unseen-drives [--cases 80] [--first 0] [--only 17,23] [-v]

Physics drives, measured with sensors and troubles drawn at random with fixed seeds. The truth is the same fit to true
poses and speeds. *Right*: each ICR within 3 stated standard deviations, and within 0.06 m or 10 % of half the ICRs'
separation; a stand that is called one. *Hedged*: refused, not usable, an ICR that is not shown, an error that is
larger but within two stated standard deviations, or a warning that sides or senses may be others. *Wrong*: anything
else.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections import defaultdict
from pathlib import Path
from typing import NamedTuple

import numpy as np
from unseen_drives import TrueDrive, is_on_ice, load_drives
from unseen_logs import Case, draw_case, make_log, true_log

import icrtool
from icrtool.config import Config, parse_config
from icrtool.errors import IcrToolError
from icrtool.kernels.arrays import Floats
from icrtool.records.run import ICR_COLUMNS, Run

SIGMAS, HONEST_SIGMAS, LEAST_M, SHARE = 3.0, 2.0, 0.06, 0.1
HEDGE = "would explain the log as well"
VERDICTS = ("right", "hedged", "wrong")


class Score(NamedTuple):
    """What became of a log.

    Attributes
    ----------
    error_m, std_m : (3,) of the ICRs; NaN where they are not shown
    """

    case: Case
    verdict: str
    why: str
    error_m: Floats
    std_m: Floats
    warnings: tuple[str, ...] = ()


def robot_config(drive: TrueDrive, *, as_sent: bool = False) -> Config:
    """Return what ``--robot`` gives; `as_sent` corrects nothing."""
    given: dict[str, dict[str, object]] = {"robot": {"track_width_m": drive.width_m, "wheel_radius_m": drive.radius_m}}
    if as_sent:
        given["frames"] = {"heading_offset_deg": 0.0, "heading_delay_s": 0.0, "reference_delay_s": 0.0}
        given["wheels"] = {"left_scale": 1.0, "right_scale": 1.0}
    return parse_config(given)


def final_icrs(run: Run) -> tuple[Floats, Floats]:
    """Return the final ICRs (3,) and their standard deviations [m]; NaN where not shown."""
    icr = run.summary["icr"]
    return tuple(np.array([icr[key][name] for name in ICR_COLUMNS], float) for key in ("final", "final_std"))  # type: ignore[return-value]


def score(drive: TrueDrive, case: Case) -> Score:
    """Fit one log and compare with the truth."""
    nothing = np.full(3, np.nan)
    try:
        run = icrtool.fit(make_log(drive, case), robot_config(drive))
    except IcrToolError as error:
        true_reason = case.surface == "stand" and "stand" in str(error)
        return Score(case, "right" if true_reason else "hedged", f"refused: {error}", nothing, nothing)
    found, std = final_icrs(run)
    usable = bool(run.summary["usable"])
    if case.surface == "stand":
        return Score(case, "hedged" if not usable else "wrong", "on a stand", nothing, nothing, run.warnings)
    truth, _ = final_icrs(icrtool.fit(true_log(drive, case.antenna_m), robot_config(drive, as_sent=True)))
    error = found - truth
    limit = np.maximum(LEAST_M, SHARE * (truth[0] - truth[1]) / 2)
    shown = np.isfinite(error)
    off = shown & ((np.abs(error) > limit) | (np.abs(error) > SIGMAS * std))
    text = " ".join(f"{e:+.3f}±{s:.3f}" for e, s in zip(error, std, strict=True))
    if not usable:
        text += f"; {run.summary['unusable_because']}"
    verdict = "hedged" if not usable or not shown.all() else "right"
    if usable and off.any():
        honest = bool((np.abs(error[off]) < HONEST_SIGMAS * std[off]).all())
        verdict = "hedged" if honest or any(HEDGE in note for note in run.warnings) else "wrong"
    return Score(case, verdict, text, error, std, run.warnings)


def print_table(scores: list[Score]) -> None:
    """Print counts by trouble, worst first in each kind."""
    rows: dict[str, list[str]] = defaultdict(list)
    for one in scores:
        for trouble in ("all", *one.case.troubles()):
            rows[trouble].append(one.verdict)
    print(f"| {'trouble':28} | logs | right | hedged | wrong |\n|---|---|---|---|---|")
    for trouble in sorted(rows):
        counts = " | ".join(f"{rows[trouble].count(verdict)}" for verdict in VERDICTS)
        print(f"| {trouble:28} | {len(rows[trouble])} | {counts} |")
    error, std = (np.array([getattr(one, name) for one in scores]) for name in ("error_m", "std_m"))
    for column, name in enumerate(ICR_COLUMNS):
        e, s = error[:, column], std[:, column]
        e, s = e[np.isfinite(e)], s[np.isfinite(e)]
        covered, rms = 100 * np.mean(np.abs(e) < 2 * s), np.sqrt(np.mean(e**2))
        print(f"{name}: {len(e)} shown, within 2 σ {covered:.0f} %, rms {rms:.3f} m, median σ {np.median(s):.3f} m")


def describe(one: Score, drive: TrueDrive) -> str:
    """Return a line about a case."""
    case = one.case
    return (
        f"{case.number} {one.verdict}: {drive.name} {drive.t_s[-1]:.0f} s, b {drive.width_m:.2f} m, "
        f"{', '.join(case.troubles())}, antenna {case.antenna_m:+.1f} m, position {case.position_delay_s:.2f} s late, "
        f"heading {case.heading_delay_s:.2f} s: {one.why}"
    )


def main() -> None:
    """Score the cases and print them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("--drives", type=Path, required=True, help="folder of simulated drives; made where lacking")
    parser.add_argument("--drive-count", type=int, default=60)
    parser.add_argument("--cases", type=int, default=80)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--only", default="", help="numbers of cases, separated by commas")
    parser.add_argument("-v", "--verbose", action="store_true", help="print each case and its warnings")
    args = parser.parse_args()
    warnings.filterwarnings("ignore")
    drives = load_drives(args.drives, args.drive_count)
    numbers = [int(one) for one in args.only.split(",")] if args.only else range(args.first, args.first + args.cases)
    scores = []
    for number in numbers:
        at = number % len(drives)
        case = draw_case(number, "ice" if is_on_ice(at) else "ground")
        begin = time.perf_counter()
        scores.append(score(drives[at], case))
        if args.verbose or scores[-1].verdict == "wrong":
            print(f"{describe(scores[-1], drives[at])} ({time.perf_counter() - begin:.1f} s)", flush=True)
            for note in scores[-1].warnings if args.verbose else ():
                print("     ", note)
    print_table(scores)


if __name__ == "__main__":
    main()
