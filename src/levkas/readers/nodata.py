"""Samples that hold nothing: a value that a file declares for them."""

from __future__ import annotations

from math import isnan
from typing import Any

import numpy as np

from levkas.readers.envi_header import parse_number


def nodata_of(text: str, dtype: np.dtype[Any], name: str) -> tuple[float | None, list[str]]:
    """Return the value of samples that hold nothing, None where there is none, and what to say of it.

    `text` is that of the field `name` of a file whose samples are of `dtype`.

    >>> nodata_of("-9999", np.dtype("u2"), "GDAL_NODATA")
    (None, ['GDAL_NODATA = -9999 is no value of uint16 samples, and is not used'])
    """
    text = text.strip(" \0")
    if not text:
        return None, []
    value = float("nan") if text.lower().strip("+-") == "nan" else parse_number(text)
    able = value is not None
    if value is not None and dtype.kind in "iu":
        info = np.iinfo(dtype)
        able = not isnan(value) and value == int(value) and info.min <= value <= info.max
    if not able:
        return None, [f"{name} = {text[:20]} is no value of {dtype.name} samples, and is not used"]
    return value, [f"samples of {text[:20]} hold nothing ({name}): they are flagged as outside"]


def without_nodata(values: np.ndarray, nodata: float | None) -> np.ndarray:
    """Return samples as floats, NaN where they hold nothing; as they are where nothing is declared.

    >>> without_nodata(np.array([7, -9999], np.int16), -9999.0).tolist()
    [7.0, nan]
    """
    if nodata is None or isnan(nodata):
        return values
    empty = values == np.asarray(nodata).astype(values.dtype)
    out = values.astype(np.float32) if values.dtype.kind in "iu" else values
    return np.where(empty, out.dtype.type(np.nan), out)
