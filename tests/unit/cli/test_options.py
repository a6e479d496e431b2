"""Options that reach a command as one argument (`icrtool.cli.options.options_as_record`)."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import dataclass

import click
import pytest
from click.testing import CliRunner

from icrtool.cli.commands import icrtool as command_line
from icrtool.cli.options import flag, option, options_as_record

COMMANDS = command_line.list_commands(click.Context(command_line))


@dataclass(frozen=True)
class Pair:
    left: float = 1.0
    right: float = 2.0


LEFT, RIGHT, OTHER = (
    option("--left", "M", float, "Left."),
    option("--right", "M", float, "Right."),
    flag("--other", "No."),
)


def call(*arguments: str, change: bool = False) -> dict[str, object]:
    """Return what a command gets."""
    found: dict[str, object] = {}

    @click.command()
    @options_as_record("pair", f"{__name__}:Pair" if change else Pair, LEFT, RIGHT, OTHER, change=change)
    def command(**given: object) -> None:
        found.update(given)

    assert CliRunner().invoke(command, list(arguments), catch_exceptions=False).exit_code == 0
    return found


def test_options_become_a_record_that_keeps_its_defaults_and_the_others_stay() -> None:
    assert call() == {"pair": Pair(), "other": False}
    assert call("--right", "5", "--other") == {"pair": Pair(1.0, 5.0), "other": True}


def test_a_change_replaces_what_is_given_of_another_record(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("icrtool.cli.options.resolve_name", lambda _: Pair)
    change = call("--left", "-3", change=True)["pair"]
    assert callable(change)
    assert change(Pair(7.0, 8.0)) == Pair(-3.0, 8.0)


@pytest.mark.parametrize("arguments", [("fit", ""), ("batch", "", "-o", "x"), ("export", "--for", "evo", "")])
def test_an_empty_name_is_not_the_current_directory(arguments: tuple[str, ...]) -> None:
    done = CliRunner().invoke(command_line, list(arguments))
    assert done.exit_code == 2
    assert "the name is empty" in done.output


@pytest.mark.parametrize("name", COMMANDS)
def test_no_record_of_a_command_has_the_name_of_one_of_its_options(name: str) -> None:
    command = command_line.get_command(click.Context(command_line), name)
    assert command is not None
    made: set[str] = getattr(command.callback, "made", set())
    assert made.isdisjoint(one.name for one in command.params if one.name is not None)


def test_help_loads_no_library_that_takes_long() -> None:
    code = (
        "import sys, click\n"
        "from icrtool.cli.commands import icrtool\n"
        f"for name in {COMMANDS}:\n"
        "    icrtool.get_command(click.Context(icrtool), name).get_help(click.Context(icrtool))\n"
        "print({'numpy', 'numba', 'pandas', 'pyarrow', 'matplotlib', 'scipy', 'rich'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
