"""Previews: PNG that says which colours its numbers mean, and what they show."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from levkas.colour.srgb import srgb_profile
from levkas.core.files import write_bytes

if TYPE_CHECKING:
    from pathlib import Path

MM_PER_INCH = 25.4
PNG_LEVEL = 4
"""Of zlib: past it, files of paintings get no smaller that is worth the time."""


def encode_png(
    image: np.ndarray, *, description: str = "", px_per_mm: float | None = None
) -> bytes:
    """Encode a picture as PNG with an sRGB profile.

    Parameters
    ----------
    image : ndarray, (height, width) or (height, width, 3), uint8
    description : str
        Kept as text in the file.
    px_per_mm : float, optional
        Sampling, kept as pixels per metre.

    Returns
    -------
    png : bytes
        The same for the same input; no date.
    """
    from PIL import Image, PngImagePlugin

    facts = PngImagePlugin.PngInfo()
    if description:
        facts.add_itxt("Description", description)
    options = {"dpi": (px_per_mm * MM_PER_INCH,) * 2} if px_per_mm else {}
    # The profile is one of RGB: a grey picture has to be called grey by gamma alone.
    profile = {"icc_profile": srgb_profile()} if image.ndim == 3 else {}
    target = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image, np.uint8)).save(
        target, "PNG", compress_level=PNG_LEVEL, pnginfo=facts, **options, **profile
    )
    return target.getvalue()


def write_preview(
    path: str | Path, image: np.ndarray, *, description: str = "", px_per_mm: float | None = None
) -> None:
    """Write `encode_png` of a picture; raises WriteRefused."""
    write_bytes(path, encode_png(image, description=description, px_per_mm=px_per_mm))
