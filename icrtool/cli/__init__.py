"""The command line: one file per command; the only package that uses click, and the only error boundary."""

from __future__ import annotations

import gc
import os
import sys
from contextlib import suppress

from icrtool.cli.process import INTERRUPTED, end_at_once, standard_streams
from icrtool.records.process_resources import use_one_arena

__all__ = ["main"]


def main() -> None:
    """Run the command line; the one place where errors become text and an exit code."""
    # BLAS is given small matrices only (a dozen columns): its threads take more time to start than they would save.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Kernels of small loops run as fast, and compile in three quarters of the time.
    os.environ.setdefault("NUMBA_OPT", "1")
    # What pyarrow frees is given back with the rest.
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    # No figure is shown, and matplotlib cannot be imported where this names no backend.
    os.environ["MPLBACKEND"] = "agg"
    if len(sys.argv) > 2:
        # Before the first thread starts; not where only help is asked for, since it takes some milliseconds.
        use_one_arena()
    # Little of what a command makes is cyclic rubbish; looking for it every 700 objects costs a tenth of loading
    # numba and matplotlib, and of drawing. What a command loads is less than so many.
    gc.set_threshold(300_000)
    with suppress(ImportError, ValueError, OSError):
        # A recording split every minute has more files than a process may open; on Windows there is no such limit.
        import resource

        resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    with end_at_once(), standard_streams() as output:
        status = _run()
        if output.lost:
            sys.stderr.write(f"Error: standard output: cannot be written; {output.lost}\n")
            status = status or 1
    # At its end the interpreter looks for cyclic rubbish among all that was imported: a tenth of a second or two.
    gc.freeze()
    sys.exit(status)


def _run() -> int:
    """Run the command that was called; return the exit status."""
    try:
        import click

        from icrtool.cli.commands import icrtool
        from icrtool.errors import IcrToolError

        if "_ICRTOOL_COMPLETE" in os.environ:
            from icrtool.cli.completion import register

            register()
        try:
            status = icrtool.main(standalone_mode=False)
        except (IcrToolError, OSError) as err:
            if isinstance(err, OSError) and err.filename is None:
                raise
            from icrtool.cli.printing import signal_word
            from icrtool.records.text import LogText

            # A path that is too long, or on a disk that fails, where no command knows more about it.
            line = f"{LogText(str(err.filename))}: {err.strerror}" if isinstance(err, OSError) else str(err)
            sys.stderr.write(f"{signal_word('Error:', 'red')} {line}\n")
            return 1
        except click.ClickException as err:
            err.show()
            return err.exit_code
        except click.Abort as err:
            raise KeyboardInterrupt from err
    except SystemExit as left:
        return left.code if isinstance(left.code, int) else int(left.code is not None)
    except KeyboardInterrupt:
        sys.stderr.write("Aborted!\n")
        return INTERRUPTED
    # Asked for help, click returns a status; a command returns nothing.
    return status if isinstance(status, int) else 0
