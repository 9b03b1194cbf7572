"""JSON text that is the same for the same record; NaN and infinities become null."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any


def to_json(record: Any) -> str:
    """Return `record` as JSON text: keys in their own order, NaN and infinities as null.

    Numpy numbers and arrays, tuples and paths become plain; anything else is a TypeError.

    >>> print(to_json({"b": 1.0, "a": float("nan")}), end="")
    {
     "b": 1.0,
     "a": null
    }
    """
    return json.dumps(plain(record), ensure_ascii=False, indent=1, allow_nan=False) + "\n"


def plain(value: Any) -> Any:
    """Return `value` with numpy numbers and arrays, tuples and paths plain, NaN and infinities None."""
    if isinstance(value, dict):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, os.PathLike):
        return Path(value).as_posix()
    if isinstance(value, int) and not isinstance(value, bool):
        return int(value)
    return value


def rounded(value: Any, digits: int) -> Any:
    """Return `value` with its numbers rounded to significant digits, arrays and tuples as lists.

    >>> rounded({"a": (0.123456, 1), "b": float("nan")}, 3)
    {'a': [0.123, 1], 'b': nan}
    """
    if isinstance(value, dict):
        return {key: rounded(one, digits) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [rounded(one, digits) for one in value]
    if hasattr(value, "tolist"):
        return rounded(value.tolist(), digits)
    return float(f"{value:.{digits}g}") if isinstance(value, float) else value
