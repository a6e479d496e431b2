"""Compare every motion model on recordings that it was not fitted to: ``benchmarks/models.py FOLDER --robot NAME``.

Each recording or run below FOLDER belongs to the ground that its folder is named after; with --ground PATTERN=NAME, to
NAME where its path holds PATTERN. For each ground every recording is left out in turn; in a single one
each trial is predicted by a fit to the rest of it.
The table is Markdown.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from icrtool.calibration.forecast import forecast_trials
from icrtool.calibration.held_out import HORIZONS_M, HeldOut, hold_out
from icrtool.calibration.pooled import calibrate_recordings, predictor
from icrtool.calibration.run_recording import turning_recording_of
from icrtool.config import Config, load_config
from icrtool.errors import IcrToolError
from icrtool.estimation.fit import fit
from icrtool.fleet.recordings import find_recordings
from icrtool.kernels.arrays import Floats
from icrtool.logs.read_log import read_log
from icrtool.motion.fit import Pool
from icrtool.motion.models import MODELS
from icrtool.motion.recording import Recording, cut_windows
from icrtool.motion.trials import cut_trials
from icrtool.output.run_directory import RUN_FILE, is_run_directory
from icrtool.output.stored_run import open_run


def main() -> None:
    """Print a table for each ground."""
    ask = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ask.add_argument("folder", type=Path)
    ask.add_argument("--robot")
    ask.add_argument("--config", type=Path)
    ask.add_argument("--ground", action="append", default=[], metavar="PATTERN=NAME")
    given = ask.parse_args()
    grounds = dict(text.split("=", 1) for text in given.ground)
    found: dict[str, list[Recording]] = {}
    for path, recording in recordings_below(given.folder, load_config(given.config, given.robot)):
        names = [name for pattern, name in grounds.items() if pattern in str(path)]
        found.setdefault(names[0] if names else path.parent.name, []).append(recording)
    for ground, recordings in found.items():
        print("\n".join(format_ground(ground, recordings)), flush=True)


def recordings_below(folder: Path, config: Config) -> Iterator[tuple[Path, Recording]]:
    """Yield runs below a folder, or else recordings, fitted; one that cannot be used is named."""
    # links to folders are not searched: they are named, two levels down
    links = (one for pattern in ("*", "*/*") for one in folder.glob(pattern) if one.is_symlink() and one.is_dir())
    places = [folder, *links]
    runs = sorted({one.parent for place in places for one in place.rglob(RUN_FILE) if is_run_directory(one.parent)})
    for path in runs or sorted(one.path for one in find_recordings(places)):
        try:
            run = open_run(path) if runs else fit(read_log(path, config), config)
            yield path, turning_recording_of(run)
        except IcrToolError as err:
            print(f"<!-- left out: {err} -->")


def format_ground(ground: str, recordings: list[Recording]) -> Iterator[str]:
    """Yield the lines of one ground's table."""
    wheels, gyro = hold_out(recordings)
    metres = sum(float(one.drive.distance[-1]) for one in recordings)
    how = "each left out in turn" if wheels.folds[0].whole else f"{len(wheels.folds)} blocks, each trial left out"
    yield f"\n**{ground}**: {len(recordings)} recorded, {metres:.0f} m; {how}\n"
    horizons = [f"{horizon:g} m" for horizon in wheels.horizons_m]
    yield "| model | " + " | ".join([*horizons, *(f"{one}, with gyro" for one in horizons)]) + " |"
    yield "|---|" + "---|" * (2 * len(horizons))
    for name in (*MODELS, "recommended"):
        with_gyro = name if name == "recommended" else f"{name}_gyro"
        row = [*cells(wheels, name), *cells(gyro, with_gyro)]
        yield f"| `{name}` | " + " | ".join(row) + " |"
    yield f"\nRecommended for all of it: `{wheels.recommended}`."
    if wheels.folds[0].whole:
        yield "\nShare of trials within the 95 % forecast of the calibration by the other logs:"
        for words, share in forecast_shares(recordings).items():
            yield f"{words} " + ", ".join(f"{one:.2f} after {h:g} m" for h, one in zip(HORIZONS_M, share, strict=True))
        yield "\nShare of parameters of one log within the combined 2 sigma of those by the other logs:"
        yield "wheels: {:.2f}, with gyro: {:.2f}".format(*parameter_shares(recordings))


def forecast_shares(recordings: list[Recording]) -> dict[str, Floats]:
    """Return the share of the trials of all left-out logs within their 95 % forecast, by wheels, and with the gyro."""
    inside: dict[str, list[Floats]] = {}
    for i, one in enumerate(recordings):
        calibration = calibrate_recordings(recordings[:i] + recordings[i + 1 :]).calibration
        trials = cut_trials(one, HORIZONS_M)
        for with_gyro in (False, True)[: 1 + (calibration.gyro is not None and one.gyro_radps is not None)]:
            errors = predictor(calibration, one, with_gyro=with_gyro)(trials)
            _, p95 = forecast_trials(calibration, one, trials, with_gyro=with_gyro)
            share = np.nanmean(np.where(np.isfinite(errors), errors <= p95, np.nan), axis=0)
            inside.setdefault("with gyro:" if with_gyro else "wheels:", []).append(share)
    return {words: np.mean(shares, axis=0) for words, shares in inside.items()}


def parameter_shares(recordings: list[Recording]) -> list[float]:
    """Return how many parameters of one log are within 2 sigma of those by the others: by wheels, and with the gyro."""
    pool = Pool([cut_windows(one) for one in recordings], [one.width_m for one in recordings])
    off: tuple[list[Floats], list[Floats]] = [], []
    for i, recording in enumerate(recordings):
        pools = Pool([pool.windows[i]], [recording.width_m]), pool.without(i)
        for model in (model for model in MODELS.values() if model.terms):
            wheels = [one.fit(model) for one in pools]
            gyro = [one.fit(model.with_gyro(), of_wheels) for one, of_wheels in zip(pools, wheels, strict=True)]
            for found, (alone, others) in zip(off, (wheels, gyro), strict=True):
                robot = [term != "wheels_weight" for term in alone.model.terms]
                found.append(((alone.parameters - others.parameters) / np.hypot(alone.std, others.std))[robot])
    return [float(np.mean(np.abs(np.concatenate(found)) < 2.0)) for found in off]


def cells(table: HeldOut | None, name: str) -> list[str]:
    """Return p95 / expected error [m] at each horizon, median over what was left out."""
    row = None if table is None else next((one for one in table.scores if one.name == name), None)
    if row is None:
        return ["", "", ""]
    return [f"{row.median('p95', h):.2f} / {row.median('expected', h):.2f}" for h in range(len(row.folds[0].p95))]


if __name__ == "__main__":
    main()
