"""Compare motion models and their priors, each held out: ``benchmarks/models.py FOLDER... --robot NAME``.

Every recording or run below a FOLDER is tested alone: each trial is predicted by a fit to the rest of its drive. Those
whose path holds the text after --pool are tested together too, each left out whole. --drives adds simulated drives of
`benchmarks/unseen_drives.py`, made where they are lacking. The tables are Markdown: expected error [m], geometric mean
over what was tested, and the largest ratio to the best row of one log.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple
from unittest.mock import patch

import numpy as np
from unseen import robot_config
from unseen_drives import is_on_ice, load_drives
from unseen_logs import draw_case, make_log

from icrtool.calibration.held_out import HELD_OUT_HORIZONS_M, errors_without, plan_folds
from icrtool.calibration.pooled import recording_of
from icrtool.config import Config, load_config
from icrtool.errors import IcrToolError
from icrtool.fleet.recordings import find_recordings
from icrtool.kernels.arrays import Floats
from icrtool.logs.read_log import read_log
from icrtool.motion.models import (
    CONTROLLER,
    FIVE,
    MODELS,
    NO_SLIP,
    RECOMMENDED,
    TERMS,
    MotionModel,
    Term,
    controller_model,
)  # fmt: skip
from icrtool.motion.recording import NO_CONSTANTS, Recording, cut_trials, cut_windows, totals_of
from icrtool.motion.window_fit import Fold, Pool, PooledFit, Prediction
from icrtool.output.run_directory import RUN_FILE, is_run_directory, open_run
from icrtool.pipeline import fit

FAMILY: dict[str, MotionModel] = MODELS | {
    model.name: model
    for model in (
        MotionModel("multiplier", "one multiplier", ("omega_w",), "wheel_separation_multiplier"),
        MotionModel("icr", "three ICRs", ("vx_w", "omega_w", "vy_w"), "Pentzer 2014, Eqs. 8-12; Martinez 2005"),
        MotionModel("six", "ICRs, scales, side slip", (*MODELS[FIVE].terms, "vy_vw"), "with Seegmiller 2014"),
    )
}
"""The models that are fitted, and simpler and older ones that they are compared with, by name."""

SLIP_TERMS = ("vy_vw", "omega_sw", "omega_vw")
WIDE, WIDTHS = 10.0, np.geomspace(0.003, 1.0, 60)


class Row(NamedTuple):
    """A model of the family, and the priors that are not those of `TERMS`; `widen` them where the data show more."""

    label: str
    model: str
    stds: Mapping[str, float] = {}
    learned: bool = False
    widen: bool = False


def scaled(names: Sequence[str], factor: float) -> dict[str, float]:
    """Return the priors of some terms, times a factor."""
    return {name: factor * TERMS[name].std for name in names}


NARROW = {"vy_vw": 0.1, "omega_sw": 0.03, "omega_vw": 0.02}
ROWS = (
    Row("no slip", NO_SLIP),
    Row("one multiplier", "multiplier"),
    Row("three ICRs", "icr"),
    Row("`controller`", CONTROLLER),
    Row("six", "six"),
    Row("eight, wide", RECOMMENDED, NARROW | {"omega_sw": 0.3, "omega_vw": 0.2}),
    Row("eight, medium", RECOMMENDED, NARROW),
    Row("eight, narrow", RECOMMENDED, scaled(SLIP_TERMS, 1.0)),
    Row("eight, very narrow", RECOMMENDED, scaled(SLIP_TERMS, 0.3)),
    Row("eight, learned", RECOMMENDED, learned=True),
    Row("eight, very narrow, wider where shown", RECOMMENDED, scaled(SLIP_TERMS, 0.3), widen=True),
    Row("**`recommended`**: narrow, wider where shown", RECOMMENDED),
)


def priors(stds: Mapping[str, float], *, widen: bool = False) -> AbstractContextManager[object]:
    """Return a context in which some terms have other priors, wider where the data show more or not."""
    wide = {name: TERMS[name].wide if widen else 0.0 for name in stds}
    changed: dict[str, Term] = {name: replace(TERMS[name], std=std, wide=wide[name]) for name, std in stds.items()}
    return patch.dict(TERMS, changed)


@dataclass(frozen=True)
class Tested:
    """Recordings that are fitted together, what each trial is predicted without, and the windows."""

    name: str
    recordings: Sequence[Recording]

    def expected(self, row: Row, stds: Mapping[str, float]) -> Floats:
        """Return the expected error (h,) of a row [m]."""
        pooled = totals_of(*self.recordings)
        windows = [cut_windows(one, pooled=pooled) for one in self.recordings]
        pool, folds = Pool(windows, [one.width_m for one in self.recordings]), plan_folds(self.recordings)
        with priors(stds, widen=row.widen):
            found = pool.fit(FAMILY[FIVE if row.model == CONTROLLER else row.model])
            errors = [
                errors_without(one, cut_trials(one, HELD_OUT_HORIZONS_M, pooled), folds, i,
                               lambda fold, one=one: predict(row.model, found, fold, one), windows[i].track).position
                for i, one in enumerate(self.recordings)
            ]  # fmt: skip
        return np.asarray(np.nanmean(np.concatenate(errors), axis=0))

    def wide(self) -> tuple[Floats, Floats]:
        """Return the slip terms (3,) as the data alone show them, and their standard deviations."""
        pool = Pool([cut_windows(one) for one in self.recordings], [one.width_m for one in self.recordings])
        with priors(scaled(SLIP_TERMS, WIDE)):
            found = pool.fit(FAMILY[RECOMMENDED])
        at = [found.model.terms.index(name) for name in SLIP_TERMS]
        return found.parameters[at], found.std[at]


def predict(name: str, found: PooledFit, fold: Fold, recording: Recording) -> Prediction | None:
    """Return what a row predicts without a fold."""
    if name == NO_SLIP:
        return found.fitted, NO_CONSTANTS
    without = found.fit_without(fold)
    if name != CONTROLLER or without is None:
        return without
    return controller_model(without[0], recording.lever, recording.width_m), without[1]


def learn_priors(shown: Sequence[tuple[Floats, Floats]]) -> dict[str, float]:
    """Return the priors of the slip terms that make the values of other logs likeliest (empirical Bayes).

    Notes
    -----
    A value of standard deviation s that is drawn about zero with tau has variance tau^2 + s^2 (Morris 1983).
    """
    value, std = (np.array(one) for one in zip(*shown, strict=True))
    variance = WIDTHS[:, None, None] ** 2 + std**2
    likelihood = -(np.log(variance) + value**2 / variance).sum(axis=1)
    return dict(zip(SLIP_TERMS, WIDTHS[likelihood.argmax(axis=0)].tolist(), strict=True))


def format_table(title: str, tested: Sequence[Tested], *, others: Sequence[Tested]) -> Iterator[str]:
    """Yield the lines of one table; priors are learned from `others` but those of the recordings tested."""
    shown = {one.name: one.wide() for one in others}
    errors = np.empty((len(ROWS), len(tested), len(HELD_OUT_HORIZONS_M)))
    for r, row in enumerate(ROWS):
        for i, one in enumerate(tested):
            mine = {recording.name for recording in one.recordings}
            apart = [value for name, value in shown.items() if name not in mine]
            errors[r, i] = one.expected(row, learn_priors(apart) if row.learned else row.stds)
    yield f"\n**{title}**\n\n| model | 5 m | 10 m | 20 m | worst ratio at 10 m |\n|---|---|---|---|---|"
    mean, ratio = np.exp(np.nanmean(np.log(errors), axis=1)), errors[:, :, 1] / np.nanmin(errors[:, :, 1], axis=0)
    for row, of_row, ratios in zip(ROWS, mean, ratio, strict=True):
        worst = int(np.nanargmax(ratios))
        cells = " | ".join(f"{value:.3f}" for value in of_row)
        yield f"| {row.label} | {cells} | {ratios[worst]:.2f} ({tested[worst].name}) |"


def recordings_below(folder: Path, config: Config) -> Iterator[tuple[Path, Recording]]:
    """Yield runs below a folder, or else recordings, fitted; one that cannot be used is named."""
    runs = sorted({one.parent for one in folder.rglob(RUN_FILE) if is_run_directory(one.parent)})
    for path in runs or sorted(one.path for one in find_recordings([folder])):
        try:
            run = open_run(path) if runs else fit(read_log(path, config), config)
            recording = recording_of(run)
            plan_folds([recording])
            yield path, recording
        except IcrToolError as err:
            print(f"<!-- left out: {err} -->")


def drives_of(folder: Path, count: int) -> Iterator[Recording]:
    """Yield simulated drives as sensors with troubles measure them; one that cannot be used is named."""
    for number, drive in enumerate(load_drives(folder, count)):
        try:
            log = make_log(drive, draw_case(number, "ice" if is_on_ice(number) else "ground"))
            run = fit(log, robot_config(drive))
            if not run.usable:
                print(f"<!-- left out: {run.name}: {run.summary['unusable_because']} -->")
                continue
            recording = recording_of(run)
            plan_folds([recording])
            yield recording
        except IcrToolError as err:
            print(f"<!-- left out: {err} -->")


def main() -> None:
    """Print a table for each folder, for the pool, and for the simulated drives."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("folders", type=Path, nargs="*", metavar="FOLDER")
    ask.add_argument("--robot")
    ask.add_argument("--config", type=Path)
    ask.add_argument("--pool", default="", metavar="TEXT")
    ask.add_argument("--drives", type=Path)
    ask.add_argument("--drive-count", type=int, default=20)
    given = ask.parse_args()
    config = load_config(given.config, given.robot)
    sets = {one.name: [*recordings_below(one, config)] for one in given.folders}
    alone = {name: [Tested(one.name, [one]) for _, one in found] for name, found in sets.items()}
    if given.drives:
        alone["simulated drives"] = [Tested(one.name, [one]) for one in drives_of(given.drives, given.drive_count)]
    everything = [one for found in alone.values() for one in found]
    for title, tested in alone.items():
        print("\n".join(format_table(f"{title}: {len(tested)} alone", tested, others=everything)), flush=True)
    together = [one for found in sets.values() for path, one in found if given.pool and given.pool in str(path)]
    if len(together) > 1:
        pool = [Tested("pool", together)]
        title = f"{given.pool}: {len(together)} together, each left out whole"
        print("\n".join(format_table(title, pool, others=everything)), flush=True)


if __name__ == "__main__":
    main()
