"""The one place where a record names the layer above it: methods such as ``run.write(path)`` are functions of `output`.

A record holds data and knows no code that uses it, yet a notebook expects ``run.write(path)``. Those methods look their
function up here by name when they are called, so that importing a record imports nothing of `icrtool.output`.
"""

from __future__ import annotations

import importlib
from typing import Any, Literal

FigureSet = Literal["default", "all"]
"""The figures that a run and its report are written with: those that answer a question, or the paper's too."""


def call_output(module: str, function: str, *arguments: object, **options: object) -> Any:  # noqa: ANN401 - the type is that of the function called
    """Return ``icrtool.output.MODULE.FUNCTION(*arguments, **options)``."""
    return getattr(importlib.import_module(f"icrtool.output.{module}"), function)(*arguments, **options)
