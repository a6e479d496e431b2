"""``icrtool cache``."""

from __future__ import annotations

import importlib
import os
import pkgutil
import tempfile
import time
from pathlib import Path

import click

from icrtool.cli.options import flag


@click.group("cache")
def command() -> None:
    """Machine code of the compiled kernels, which the first commands on a computer otherwise wait for."""


@command.command("warm")
@flag("-q --quiet", "Print no result.")
def warm(*, quiet: bool) -> None:
    """Compile all kernels and modules now, so that no later command waits for it: for an image or a CI cache.

    The kernels' code is kept in NUMBA_CACHE_DIR; without it, beside the installed package, or else in the user's
    cache. From a NUMBA_CACHE_DIR that can only be read it is used too. With NUMBA_CPU_NAME=generic, here and in later
    commands, it runs on any processor of this architecture.

    \b
    Example:
      export NUMBA_CACHE_DIR=$HOME/kernels NUMBA_CPU_NAME=generic
      icrtool cache warm
    """  # noqa: D301 - click reads the escape
    import icrtool
    from icrtool.errors import OutputError
    from icrtool.kernels.compiled import all_kernels, processor

    begin = time.perf_counter()
    for module in pkgutil.walk_packages(icrtool.__path__, "icrtool."):
        # Python keeps what it compiled of a module that is imported
        importlib.import_module(module.name)
    kernels = list(all_kernels())
    place = Path(kernels[0].stats.cache_path or os.devnull)
    wanted = Path(os.environ.get("NUMBA_CACHE_DIR") or place)
    try:
        tempfile.TemporaryFile(dir=place).close()
        # numba takes another place where it cannot use the one that it was given
        place.relative_to(wanted)
    except (OSError, ValueError) as err:
        raise OutputError(wanted, "cannot be written", "set NUMBA_CACHE_DIR to a directory that can") from err
    call_all_kernels()
    if not quiet:
        compiled = sum(bool(one.stats.cache_misses) for one in kernels)
        click.echo(
            f"{compiled} of {len(kernels)} kernels compiled for {processor()}, in {time.perf_counter() - begin:.1f} s; "
            f"kept in {wanted}"
        )


def call_all_kernels() -> None:
    """Call each kernel with the types that the commands call it with: drive a robot, fit, smooth, report and study."""
    from dataclasses import replace

    import numpy as np

    import icrtool
    from icrtool.cli.simulate import needed
    from icrtool.estimation.run_filter import smooth
    from icrtool.kernels.open_loop import open_loop_errors_direct
    from icrtool.kernels.track import FrozenIcrs, trial_ends
    from icrtool.logs.write_log import WriteOptions, write_log
    from icrtool.records.process_resources import unfinished
    from icrtool.records.run import track_of
    from icrtool.simulation.drives import DrivePlan, Sensors
    from icrtool.simulation.record import simulate
    from icrtool.simulation.studies import default_request, run_study

    config = icrtool.load_config(robot="husky-a200")
    columns, _ = simulate(DrivePlan(motor_lag_s=0.1), Sensors(), 0)
    options = WriteOptions(
        wheel_radius_m=needed(config, "wheel_radius_m"), track_width_m=needed(config, "track_width_m")
    )
    with tempfile.TemporaryDirectory() as folder, unfinished(Path(folder)):
        log = icrtool.read_log(write_log(Path(folder) / "drive.mcap", columns, options), config)
    run = icrtool.fit(log, config)
    icrtool.dropout(run)
    smooth(run)
    track = track_of(run)
    open_loop_errors_direct(track, FrozenIcrs.constant(0.4, -0.4, 0.0), trial_ends(track, np.array([1.0])))
    request = default_request("consistency", config)
    run_study(replace(request, runs=1, plan=replace(request.plan, duration_s=10.0)))
