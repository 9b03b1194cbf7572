"""Values of TIFF tags, of files that may be damaged: no pixel depends on them."""

from __future__ import annotations

from math import isfinite
from typing import Any

import numpy as np

RATIONAL = (5, 10)  # types of tags


def value_of(tags: Any, name: str | int) -> Any:
    """Return a tag's value, None where it is absent or cannot be read."""
    try:
        if isinstance(name, str):  # for which tifffile would look through all tags
            from tifffile import TIFF

            name = next((code for code in TIFF.TAGS.getall(name, []) if code in tags), -1)
        return tags[name].value if name in tags else None
    except Exception:  # a damaged directory leads tifffile to many kinds of errors
        return None


def numbers_of(tags: Any, name: str | int) -> tuple[float, ...]:
    """Return a tag's finite numbers, rationals divided; none where it holds text, or nothing."""
    value = value_of(tags, name)
    if value is None or isinstance(value, str | bytes):
        return ()
    try:
        numbers = [float(v) for v in np.atleast_1d(np.asarray(value, float)).ravel()]
    except (TypeError, ValueError):
        return ()
    if int(tags[name].dtype) in RATIONAL:
        pairs = zip(numbers[::2], numbers[1::2], strict=False)
        numbers = [top / bottom for top, bottom in pairs if bottom]
    return tuple(n for n in numbers if isfinite(n))
