"""Plain data, which JSON holds and returns unchanged; and the records of JSON documents."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import msgspec
import numpy as np


class Record(msgspec.Struct, frozen=True):
    """Part of a JSON document. Reading checks the types of its fields, and ignores unknown keys."""


def finite_or_none(value: float) -> float | None:
    """Return a finite number; None for infinity and NaN."""
    return value if math.isfinite(value) else None


def plain_value(value: object) -> Any:  # noqa: ANN401 - whatever JSON holds
    """Return a value as lists, dicts, texts and numbers, as JSON gives it back; None for infinity and NaN.

    Fields of a dataclass with ``compare=False`` and fields that are UNSET are left out.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    # Single values are tested first: most values are single, and the other tests take longer.
    if value is None or isinstance(value, str | int):
        return value
    if isinstance(value, float):
        return finite_or_none(value)
    if isinstance(value, msgspec.Struct):
        value = dict(zip(value.__struct_encode_fields__, msgspec.structs.astuple(value), strict=True))
    elif is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value) if field.compare}
    if isinstance(value, Mapping):
        return {str(key): plain_value(item) for key, item in value.items() if item is not msgspec.UNSET}
    if isinstance(value, list | tuple):
        return [plain_value(item) for item in value]
    return value
