"""Pictures that are not drawn, for tests of numbers and files: drawing is half of the CPU time of a page."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pytest


@contextmanager
def blank_pictures() -> Iterator[None]:
    """Have each picture of the catalogue white and 8 pixels wide; tests/unit/output draws all of them."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from icrtool.output.figure_catalogue import Entry

    blank = Figure(figsize=(0.08, 0.08), dpi=100)
    FigureCanvasAgg(blank)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Entry, "draw", property(lambda _: lambda *_, **__: blank))
        yield
