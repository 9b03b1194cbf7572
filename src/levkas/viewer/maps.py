"""Maps of how far a layer can be trusted: its flags, its noise, its registration, as pictures."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.flags import MARKS
from levkas.database.tiff_pages import open_pages
from levkas.geometry.pixel_frames import Frame, Records

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from levkas.database.tiff_pages import TiffPages

SCALE = ((20, 17, 15), (60, 32, 64), (122, 46, 76), (181, 83, 51), (217, 154, 60), (250, 236, 190))
"""Colours of a scalar map from least to most; lightness rises evenly."""
UNKNOWN = (70, 72, 76)
CLEAR = (24, 22, 19)
PERCENTILES = (1.0, 99.0)
BLOCK_BYTES = 64_000_000
"""Read at once: so many rows of all bands, and at least one."""
MOST_BYTES_SSIM = 2_000_000_000
MOST_PLACES = 2_000_000
"""Where a predicted error is computed; between them it is repeated."""


@dataclass(frozen=True)
class Legend:
    """What the colours of a map say: named ones, or a scale from `least` to `most`."""

    entries: tuple[tuple[str, tuple[int, int, int]], ...] = ()
    least: str = ""
    most: str = ""

    def to_dict(self) -> dict[str, Any]:
        """Return what a page needs."""
        colours = self.entries or tuple(("", colour) for colour in SCALE)
        return {
            "entries": [
                {"name": name, "colour": "#{:02x}{:02x}{:02x}".format(*rgb)}
                for name, rgb in colours
            ],
            "least": self.least,
            "most": self.most,
        }


def flag_map(path: Path) -> tuple[np.ndarray, np.ndarray, Legend]:
    """Return the gravest flag of every pixel as a number, the numbers' colours, and the legend.

    Parameters
    ----------
    path : Path
        A layer's flags.

    Returns
    -------
    image : ndarray, (height, width), uint8
        0 where no band has a flag; the last colour only where all bands are outside.
    palette : ndarray, (n, 3), uint8
    legend : Legend
        Only of what occurs.
    """
    pages = open_pages(path)
    height, width, _ = pages.shape
    image = np.zeros((height, width), np.uint8)
    for rows in blocks_of(pages):
        either = np.bitwise_or.reduce(pages.read(rows.start, rows.stop), axis=2)
        for number, flag in enumerate(MARKS, start=1):
            image[rows][(either & flag.value) != 0] = number
    palette = np.array([CLEAR, *(mark.colour for mark in MARKS.values())], np.uint8)
    there = np.unique(image)
    names = [("no flag", CLEAR), *((mark.meaning, mark.colour) for mark in MARKS.values())]
    return image, palette, Legend(tuple(names[number] for number in there))


def sigma_map(path: Path) -> tuple[np.ndarray, Legend]:
    """Return the mean sigma over the bands as a picture, and its legend; NaN is grey."""
    pages = open_pages(path)
    mean = np.empty(pages.shape[:2], np.float32)
    for rows in blocks_of(pages):
        some = pages.read(rows.start, rows.stop)
        known = np.isfinite(some)
        total = np.where(known, some, 0).sum(2, dtype=np.float64)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean[rows] = total / known.sum(2)
    finite = mean[np.isfinite(mean)]
    low, high = np.percentile(finite, PERCENTILES) if finite.size else (0.0, 1.0)
    return colour_scale(mean, low, high), Legend(least=f"{low:.2g}", most=f"{high:.2g}")


def registration_map(
    database: Path, item: str, record: dict[str, Any], size: tuple[int, int]
) -> tuple[np.ndarray, Legend] | None:
    """Return the predicted error of a registration over the grid, px of the reference.

    The worst band's, as its record has it in a few nodes, linear between them. None where the
    record has none.
    """
    bands = record.get("bands", {}).values() if record else ()
    tables = (band["sigma"] for band in bands if isinstance(band, dict) and band.get("sigma"))
    known = list({json.dumps(table, sort_keys=True): table for table in tables}.values())
    if not known:
        return None
    width, height = size
    step = math.ceil(math.sqrt(width * height / MOST_PLACES))
    x, y = np.meshgrid(np.arange(0.0, width, step), np.arange(0.0, height, step))
    grid = Records(database, item).pixels(Frame())
    places = grid.from_reference.inverse(np.stack([x.ravel(), y.ravel()], 1))
    worst = np.max([_between(table, places) for table in known], axis=0).reshape(x.shape)
    most = float(np.nanmax(worst, initial=0.0, where=np.isfinite(worst)))
    picture = colour_scale(worst, 0.0, most).repeat(step, 0).repeat(step, 1)
    return picture[:height, :width], Legend(least="0", most=f"{most:.2g} px of the reference")


def similarity_map(tiff: Path, reference: Path) -> tuple[np.ndarray, Legend] | None:
    """Return the SSIM of a layer against the reference camera's, or None where it says nothing."""
    from levkas.building.resampling import read_grey
    from levkas.quality.evaluation.similarity import structural_similarity

    sizes = [int(np.prod(open_pages(path).shape)) * 4 for path in (tiff, reference)]
    if max(sizes) > MOST_BYTES_SSIM:
        return None
    (target, seen), (other, there) = read_grey(tiff), read_grey(reference)
    if target.shape != other.shape:
        return None
    score, full = structural_similarity(other, target, seen & there)
    if np.isnan(score):
        return None
    return colour_scale(full, 0.0, 1.0), Legend(least="0", most="1, alike")


def blocks_of(pages: TiffPages) -> Iterator[slice]:
    """Yield slices of rows that together are the whole, each of about `BLOCK_BYTES`."""
    height, width, bands = pages.shape
    step = max(1, BLOCK_BYTES // (width * bands * pages.dtype.itemsize))
    return (slice(start, min(height, start + step)) for start in range(0, height, step))


def colour_scale(values: np.ndarray, low: float, high: float) -> np.ndarray:
    """Return numbers as colours of `SCALE`, uint8 (…, 3); NaN is `UNKNOWN`.

    >>> colour_scale(np.array([0.0, 1.0, np.nan]), 0, 1).tolist()
    [[20, 17, 15], [250, 236, 190], [70, 72, 76]]
    """
    span = high - low if high > low else 1.0
    known = np.isfinite(values)
    place = np.clip(np.where(known, (values - low) / span, 0), 0, 1)
    table = np.array(SCALE, float)
    colours = np.stack(
        [np.interp(place, np.linspace(0, 1, len(table)), column) for column in table.T], -1
    )
    return np.where(known[..., None], np.round(colours), UNKNOWN).astype(np.uint8)


def _between(table: dict[str, Sequence[Any]], places: np.ndarray) -> np.ndarray:
    """Interpolate a table of nodes linearly; beyond the nodes, what the nearest say."""
    xs, ys = (np.asarray(table[axis], float) for axis in "xy")
    values = np.array(table["sigma_px"], float)
    column, row = (_fraction(nodes, places[:, i]) for i, nodes in enumerate((xs, ys)))
    c, r = (np.minimum(part.astype(int), n - 2) for part, n in ((column, len(xs)), (row, len(ys))))
    u, v = column - c, row - r
    top = values[r, c] * (1 - u) + values[r, c + 1] * u
    return top * (1 - v) + (values[r + 1, c] * (1 - u) + values[r + 1, c + 1] * u) * v


def _fraction(nodes: np.ndarray, places: np.ndarray) -> np.ndarray:
    return np.interp(places, nodes, np.arange(len(nodes), dtype=float))
