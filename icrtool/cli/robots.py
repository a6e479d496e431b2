"""``icrtool robots``."""

from __future__ import annotations

import click

from icrtool.cli import options
from icrtool.cli.printing import Printer
from icrtool.output.text_blocks import Line, Table


@click.command("robots")
@options.printing(options.AS_JSON)
def command(printer: Printer) -> None:
    """List the built-in robots for --robot, with their numbers and sources.

    For another robot, give --set robot.track_width_m=… and --set robot.wheel_radius_m=…, or a file: icrtool config
    prints one to fill in.
    """
    from icrtool.config import builtin_robots

    robots = builtin_robots()
    keys = ("track_width_m", "wheel_radius_m", "encoder_counts_per_rev", "source")
    listed = [{"name": name} | {key: robot.get(key) for key in keys} for name, robot in robots.items()]
    printer.json("robots", {"robots": listed})
    rows = [
        (
            name, f"{robot['track_width_m']:.3f} m", f"{robot['wheel_radius_m']:.4f} m",
            f"{robot['encoder_counts_per_rev']:,}" if "encoder_counts_per_rev" in robot else "-",
        )
        for name, robot in robots.items()
    ]  # fmt: skip
    head = ("robot", "track width", "wheel radius", "counts per turn")
    sources = Table("l", [(f"  {name}", robot["source"]) for name, robot in robots.items()])
    printer.show([Table("lr", rows, head), "", Line("Sources", "title"), sources])
