"""A layer as a notebook shows it: its picture, its verdict, what its flags mark."""

from __future__ import annotations

import base64
import io
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.flags import MARKS
from levkas.core.problems import Refused

if TYPE_CHECKING:
    import xarray

PICTURE_PX = 240
SAMPLED = 400_000
"""Flags that are looked at, at even steps: a notebook draws an array each time that it is named."""


def describe_in_html(array: xarray.DataArray) -> str:
    """Return HTML with the preview of an array's pixels, the verdict of its layer and the shares of its flags; empty where none is known."""
    rows = []
    try:
        rows.append(("verdict", escape(array.levkas.verdict or "not known")))
        rows += [(name, share) for name, share in _shares(array)] or [("flags", "none")]
    except (Refused, OSError, ValueError):
        return ""
    cells = "".join(
        f"<tr><th style='text-align:left'>{name}</th><td>{text}</td></tr>" for name, text in rows
    )
    return f"<div style='display:flex;gap:1em;align-items:start'>{_picture(array)}<table>{cells}</table></div>"


def _picture(array: xarray.DataArray) -> str:
    from PIL import Image

    try:
        pixels: Any = array.levkas.preview.transpose("y", "x", ...).values
    except (Refused, OSError, ValueError):  # single rows, or a database without pictures
        return ""
    if 0 in pixels.shape[:2]:
        return ""
    picture = Image.fromarray(pixels)
    picture.thumbnail((PICTURE_PX, PICTURE_PX))
    picture.save(packed := io.BytesIO(), "PNG")
    data = base64.b64encode(packed.getvalue()).decode()
    name = escape(str(array.layer.values))
    return f"<img alt='{name}' src='data:image/png;base64,{data}'>"


def _shares(array: xarray.DataArray) -> list[tuple[str, str]]:
    """Return the flags that mark something, and the share of the pixels looked at that any band has it."""
    steps = max(1, int(np.ceil(np.sqrt(array.size / SAMPLED))))
    part = array.isel({axis: slice(None, None, steps) for axis in ("x", "y") if axis in array.dims})
    flags = part.levkas.flags
    axis = next((d for d in flags.dims if d not in ("x", "y")), None)
    marks = (
        flags.values
        if axis is None
        else np.bitwise_or.reduce(flags.values, axis=flags.get_axis_num(axis))
    )
    found = []
    for flag, mark in MARKS.items():
        share = float(np.mean((marks & np.uint8(flag)) > 0)) if marks.size else 0.0
        if share > 0:
            found.append((mark.word, f"{100 * share:.2g} % of pixels"))
    return found
