"""Lay pictures of setups out on a contact sheet."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from levkas.planning.contact_sheet import Rendered

GAP, HEAD, LABEL = 14, 64, 26
PAPER, INK, SOFT = (24, 22, 18), (236, 231, 218), (167, 159, 141)
EXPOSED = 1.0
"""White of the board on the sheet; brighter gold is shown burnt out, as a camera would."""


def to_srgb(linear: np.ndarray) -> np.ndarray:
    """Return 8-bit sRGB of linear values over white.

    >>> to_srgb(np.array([0.0, 0.2140, 1.0, 2.0])).tolist()
    [0, 127, 255, 255]
    """
    c = np.clip(linear / EXPOSED, 0, 1)
    coded = np.where(c <= 0.0031308, 12.92 * c, 1.055 * np.maximum(c, 1e-9) ** (1 / 2.4) - 0.055)
    return (255 * coded + 0.5).astype(np.uint8)


def lay_out(pictures: Sequence[Rendered], title: str) -> Any:
    """Return the sheet as a PIL image: a row a setup, the whole object and its close-ups."""
    from PIL import Image, ImageDraw, ImageFont

    names = list(pictures[0].details)
    tall = max(p.whole.shape[0] for p in pictures)
    wide = pictures[0].whole.shape[1]
    width = GAP + wide + GAP + len(names) * (tall + GAP)
    row = tall + LABEL + GAP
    sheet = Image.new("RGB", (width, HEAD + len(pictures) * row), PAPER)
    draw = ImageDraw.Draw(sheet)
    big, small = ImageFont.load_default(21), ImageFont.load_default(14)
    draw.text((GAP, 12), title or "Setups", INK, big)
    for k, name in enumerate(names):
        draw.text((GAP + wide + GAP + k * (tall + GAP), 40), name, SOFT, small)
    for i, picture in enumerate(pictures):
        top = HEAD + i * row
        sheet.paste(Image.fromarray(to_srgb(picture.whole)), (GAP, top))
        for k, name in enumerate(names):
            detail = Image.fromarray(to_srgb(picture.details[name])).resize((tall, tall), 3)
            sheet.paste(detail, (GAP + wide + GAP + k * (tall + GAP), top))
        words = f"{picture.name}: {picture.title}" if picture.title else picture.name
        draw.text((GAP, top + tall + 4), words, INK, small)
    return sheet
