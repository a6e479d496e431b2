"""Words to calls: one file a command; the only room with click, and the one error boundary."""

from __future__ import annotations

import gc
import os
import sys

__all__ = ["main"]


def main() -> None:
    """Run the command line; the one place where errors become text and an exit code."""
    # BLAS is given small matrices only (a dozen columns): its threads take more time to start than they would save
    # there, and a process with threads should not be forked.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # Little of what a command makes is cyclic rubbish; looking for it every 700 objects costs a tenth of loading
    # numba and matplotlib, and of drawing.
    gc.set_threshold(100_000)
    from icrtool.cli.commands import icrtool
    from icrtool.errors import IcrToolError

    for stream in (sys.stdout, sys.stderr):
        # A terminal that cannot show a degree sign gets a question mark, not a traceback.
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
    try:
        icrtool()
    except IcrToolError as err:
        sys.stderr.write(f"Error: {err}\n")
        sys.exit(1)
