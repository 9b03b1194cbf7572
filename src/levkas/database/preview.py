"""Previews: PNG that says which colours its numbers mean, and what they show."""

from __future__ import annotations

import io

import numpy as np

from levkas.colour.srgb import srgb_profile

MM_PER_INCH = 25.4
PNG_LEVEL = 4
"""Of zlib: past it, files of paintings get no smaller that is worth the time."""


def encode_png(
    image: np.ndarray, *, description: str = "", px_per_mm: float | None = None
) -> bytes:
    """Encode a uint8 picture, (height, width) or (height, width, 3), as PNG with an sRGB profile.

    `description` is kept as text, the sampling as pixels per metre, and no date: the same bytes for the same input.
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
