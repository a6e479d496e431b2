"""``icrtool robots``."""

from __future__ import annotations

import textwrap

import click

from icrtool.cli.json_output import json_option, print_json

SOURCE_WIDTH = 96


@click.command("robots")
@json_option
def command(as_json: bool) -> None:
    """List the built-in robots for --robot, with their numbers and the sources of them.

    For another robot, give --set robot.track_width_m=… and --set robot.wheel_radius_m=…, or a file: icrtool config
    prints one to fill in.
    """
    from icrtool.config import builtin_robots

    robots = builtin_robots()
    if as_json:
        keys = ("track_width_m", "wheel_radius_m", "encoder_counts_per_rev", "source")
        listed = [{"name": name} | {key: robot.get(key) for key in keys} for name, robot in robots.items()]
        print_json("robots", {"robots": listed})
        return
    width = max(len(name) for name in robots)
    click.echo(f"{'robot':<{width}}  track width  wheel radius  counts per turn")
    for name, robot in robots.items():
        counts = f"{robot['encoder_counts_per_rev']:,}" if "encoder_counts_per_rev" in robot else "-"
        numbers = f"{robot['track_width_m']:9.3f} m  {robot['wheel_radius_m']:10.4f} m  {counts:>15}"
        click.echo(f"{name:<{width}}  {numbers}")
        source = textwrap.wrap(robot["source"], SOURCE_WIDTH, initial_indent="  ", subsequent_indent="  ")
        click.echo("\n".join(source))
