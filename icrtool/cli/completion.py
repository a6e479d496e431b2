"""``icrtool completion``: commands, options, robots, configuration keys and topics of a log, completed by the shell."""

from __future__ import annotations

import click
from click.shell_completion import BashComplete, CompletionItem, add_completion_class, get_completion_class

SHELLS = ("bash", "zsh", "fish")

NAME, VARIABLE = "icrtool", "_ICRTOOL_COMPLETE"

NO_BLANK_AFTER_EQUALS = """\
    [[ ${#COMPREPLY[@]} == 1 && ${COMPREPLY[0]} == *= ]] && compopt -o nospace
    return 0
"""


class BashWithEquals(BashComplete):
    """Completes ``--set key=value``: bash ends a word at ``=``, and replaces only what follows it."""

    source_template = BashComplete.source_template.replace("    return 0\n", NO_BLANK_AFTER_EQUALS, 1)

    def get_completion_args(self) -> tuple[list[str], str]:
        """Return the words before the one to complete, and that one; words that bash cut at ``=`` are joined."""
        args, incomplete = super().get_completion_args()
        rest, words = [*args, incomplete], [""]
        while rest:
            word = rest.pop(0)
            if word != "=":
                words.append(word)
            elif words[-1].startswith("-"):
                words.append(rest.pop(0) if rest else "")
            else:
                words[-1] += f"={rest.pop(0) if rest else ''}"
        return words[1:-1], words[-1]

    def format_completion(self, item: CompletionItem) -> str:
        """Return a completion without what stands before its ``=``."""
        key, equals, value = item.value.partition("=")
        after = value if equals and value else f"{key}{equals}"
        return f"{item.type},{after}"


def register() -> None:
    """Have click use the completion above; called before it looks whether a shell asks for one."""
    add_completion_class(BashWithEquals, "bash")


@click.command("completion")
@click.argument("shell", type=click.Choice(SHELLS))
def command(shell: str) -> None:
    """Print what a shell needs to complete commands, options, robots, configuration keys and topics of a log.

    \b
    One line in the shell's start-up file:
      eval "$(icrtool completion bash)"        # in ~/.bashrc
      eval "$(icrtool completion zsh)"         # in ~/.zshrc, after compinit
      icrtool completion fish | source         # in ~/.config/fish/config.fish
    """  # noqa: D301 - click reads the escape
    from icrtool.cli.commands import icrtool

    register()
    kind = get_completion_class(shell)
    if kind is None:
        raise click.UsageError(f"click knows no completion for {shell}")
    click.echo(kind(icrtool, {}, NAME, VARIABLE).source())


def complete_robot(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the built-in robots that begin with `incomplete`."""
    from icrtool.config import builtin_robots

    return [
        CompletionItem(name, help=f"track width {robot['track_width_m']:g} m")
        for name, robot in builtin_robots().items()
        if name.startswith(incomplete)
    ]


def complete_setting(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Return the keys that begin with `incomplete`, or the values of a key: its words, or the topics of the log."""
    from icrtool.config import SECTIONS, key_texts, words_of_key

    key, equals, begun = incomplete.partition("=")
    section, _, name = key.partition(".")
    if not equals:
        texts = key_texts()
        keys = [(f"{one}.{two}", texts[one][two]["text"]) for one in SECTIONS for two in texts[one]]
        return [CompletionItem(f"{one}=", help=text) for one, text in keys if one.startswith(incomplete)]
    if section == "topics":
        # Without the value of --set, click leaves what stands before it in `args`.
        values = _topics(ctx.params.get("logs") or ctx.params.get("sources") or ctx.args)
    else:
        values = words_of_key(section, name)
    return [CompletionItem(f"{key}={value}") for value in values if value.startswith(begun)]


def _topics(logs: object) -> tuple[str, ...]:
    """Return the topics of the logs that were named before, as far as they can be read and are names of ROS.

    Bash puts a completion into the line without quoting it: no other text of a log must come there.
    """
    import re
    from pathlib import Path

    from icrtool.errors import IcrToolError
    from icrtool.logs.containers.open_log import open_log

    topics: set[str] = set()
    for log in logs if isinstance(logs, tuple | list) else ():
        if log == "-":
            continue  # a completion must not wait for its input
        try:
            container = open_log(Path(log))
        except IcrToolError:
            continue
        topics |= {str(one.topic) for one in container.channels if re.fullmatch(r"[\w/~.-]+", one.topic, re.ASCII)}
        container.close()
    return tuple(sorted(topics))
