"""Maps of a layer as pictures: flags, sigma, predicted error of the registration, each with its scale."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.flags import MARKS
from levkas.database.pixel_frames import predict_error
from levkas.database.registrations import object_outline
from levkas.database.tiff_pages import open_pages
from levkas.geometry import from_dict
from levkas.pages.budget import describe_number
from levkas.pages.page import embed_png

if TYPE_CHECKING:
    from levkas.database.tiff_pages import TiffPages

SCALE = ((20, 17, 15), (60, 32, 64), (122, 46, 76), (181, 83, 51), (217, 154, 60), (250, 236, 190))
"""Colours of a scalar map from least to most; lightness rises evenly."""

UNKNOWN = (70, 72, 76)

OUTLINE = (64, 200, 235)
"""Of the object, over its picture: cyan is rare in paintings."""

OUTSIDE = 110
"""Brightness of a picture outside the outline, 0 to 255: dark enough to be visible at the size of a stamp."""

CLEAR = (24, 22, 19)

PERCENTILES = (1.0, 99.0)

BLOCK_BYTES = 64_000_000
"""Read at once: so many rows of all bands, and at least one."""

MOST_SHOWN = 24
"""Bands over which sigma is averaged for a picture: it is smooth in wavelength, and to read all takes seconds."""

MOST_PLACES = 2_000_000
"""Where a predicted error is computed; between them it is repeated."""


@dataclass(frozen=True)
class Legend:
    """Meaning of the colours of a map: named ones, or a scale from `least` to `most`."""

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
        either = reduce(np.bitwise_or, pages.planes(rows.start, rows.stop))
        for number, flag in enumerate(MARKS, start=1):
            image[rows][(either & flag.value) != 0] = number
    palette = np.array([CLEAR, *(mark.colour for mark in MARKS.values())], np.uint8)
    there = np.unique(image)
    names = [("no flag", CLEAR), *((mark.meaning, mark.colour) for mark in MARKS.values())]
    return image, palette, Legend(tuple(names[number] for number in there))


def sigma_map(path: Path) -> tuple[np.ndarray, Legend]:
    """Return the mean sigma over the bands, over every n-th of more than `MOST_SHOWN`, and its legend; NaN is grey."""
    pages = open_pages(path)
    every = math.ceil(len(pages) / MOST_SHOWN)
    shown = range(every // 2, len(pages), every)
    mean = np.empty(pages.shape[:2], np.float32)
    for rows in blocks_of(pages):
        shape = (rows.stop - rows.start, pages.shape[1])
        total, count = np.zeros(shape), np.zeros(shape, np.int32)
        for plane in pages.planes(rows.start, rows.stop, shown):
            known = np.isfinite(plane)
            np.add(total, plane, out=total, where=known)
            count += known
        with np.errstate(invalid="ignore", divide="ignore"):
            mean[rows] = total / count
    finite = mean[np.isfinite(mean)]
    low, high = np.percentile(finite, PERCENTILES) if finite.size else (0.0, 1.0)
    return colour_scale(mean, low, high), Legend(
        least=describe_number(low), most=describe_number(high)
    )


def registration_map(
    record: Mapping[str, Any], size: tuple[int, int]
) -> tuple[np.ndarray, Legend] | None:
    """Return the predicted error of a registration over the grid, px of the reference.

    The worst band's; grey where nothing confirms the map. None where the record has none.
    """
    step = math.ceil(math.sqrt(size[0] * size[1] / MOST_PLACES))
    worst = predict_error(record, size, step)
    if worst is None:
        return None
    most = float(np.nanmax(worst, initial=0.0, where=np.isfinite(worst)))
    picture = colour_scale(worst, 0.0, most).repeat(step, 0).repeat(step, 1)
    return picture[: size[1], : size[0]], Legend(least="0", most=f"{most:.2g} px of the reference")


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


# --- small ones, for a report --------------------------------------------------------------------

ERROR_PERCENTILE = 95.0
"""Of the predicted error, at which its scale ends: it grows manifold in the last corner."""
LONGEST_SIDE = 360
"""Pixels of the longer side of a map in a report."""


@dataclass(frozen=True)
class ReportMap:
    """One small map in a report, as a data address, with its scale."""

    title: str
    source: str
    legend: Legend
    doubt: str = ""
    """What no colour of the scale says."""

    @property
    def gradient(self) -> str:
        """The scale as colours of CSS; empty where colours have names."""
        if self.legend.entries:
            return ""
        return ", ".join("rgb({} {} {})".format(*colour) for colour in SCALE)


def draw_maps(
    record: Mapping[str, Any], tiff: Path, quantity: str, sigma: Mapping[str, Any] | None
) -> list[ReportMap]:
    """Return the maps of one layer: predicted error, sigma and flags, those that there are.

    Parameters
    ----------
    record : mapping
        Of the layer's registration.
    tiff : Path
        The layer; flags and preview lie beside it.
    quantity : str
        Of its values.
    sigma : mapping, optional
        Its map of sigma, as `levkas.stages.capture_statistics.LayerStatistics.sigma_map` notes it.
    """
    maps = []
    size = (int(record["grid"]["size"][0]), int(record["grid"]["size"][1]))
    step = max(1, math.ceil(max(size) / LONGEST_SIDE))
    preview = tiff.with_suffix(".png")
    if len(outline := object_outline(record)) and preview.is_file():
        maps.append(_draw_outline(preview, record, outline))
    error = predict_error(record, size, step)
    if error is not None and np.isfinite(error).any() and np.nanmax(error) > 0:
        most, top = (float(np.nanpercentile(error, q)) for q in (ERROR_PERCENTILE, 100))
        legend = Legend(least="0", most=f"{most:.2g} px{' or more' if top > most else ''}")
        doubt = "Grey: nothing confirms the map." if np.isnan(error).any() else ""
        maps.append(
            _small("Error of the registration", colour_scale(error, 0.0, most), legend, doubt)
        )
    if sigma is not None:
        levels = _levels(sigma["png"])
        picture = colour_scale(np.where(levels, levels, np.nan), 1, 255)
        legend = Legend(
            least=describe_number(sigma["least"]),
            most=f"{describe_number(sigma['most'])} {quantity}".strip(),
        )
        maps.append(_small("Sigma", picture, legend))
    if (flags := tiff.with_name(f"{tiff.stem}.flags.tif")).is_file():
        numbers, palette, legend = flag_map(flags)
        maps.append(_small("Flags", palette[_block_maximum(numbers, step)], legend))
    return maps


def _levels(png: str) -> np.ndarray:
    """Return a grey picture, uint8 (h, w), of PNG as text."""
    from PIL import Image

    with Image.open(io.BytesIO(base64.b64decode(png))) as picture:
        return np.asarray(picture)


def _draw_outline(preview: Path, record: Mapping[str, Any], outline: np.ndarray) -> ReportMap:
    """Return a layer's picture with the outline within which it was compared."""
    from PIL import Image, ImageDraw

    corners = from_dict(record["grid"]["transform"]).inverse(outline)
    with Image.open(preview) as shown:
        picture = shown.convert("RGB")
    # Grid px → px of the preview, both by their edges.
    corners = (corners + 0.5) * np.array(picture.size) / record["grid"]["size"] - 0.5
    scale = min(1.0, LONGEST_SIDE / max(picture.size))
    small = picture.resize([max(1, round(side * scale)) for side in picture.size])
    corners = (corners + 0.5) * scale - 0.5
    closed = [tuple(corner) for corner in np.vstack([corners, corners[:1]]).tolist()]
    within = Image.new("L", small.size, OUTSIDE)
    ImageDraw.Draw(within).polygon(closed, fill=255)
    small = Image.composite(small, Image.new("RGB", small.size), within)
    ImageDraw.Draw(small).line(closed, fill=OUTLINE, width=3)
    mask = record["model"]["mask"]
    how = "Found on an even ground." if mask["automatic"] else "As declared."
    return _small(
        "Outline of the object", np.asarray(small), Legend((("compared within", OUTLINE),)), how
    )


def _small(title: str, picture: np.ndarray, legend: Legend, doubt: str = "") -> ReportMap:
    from levkas.database.preview import encode_png

    return ReportMap(title, embed_png(encode_png(np.ascontiguousarray(picture))), legend, doubt)


def _block_maximum(image: np.ndarray, step: int) -> np.ndarray:
    """Return the greatest value of every block of `step` pixels a side.

    >>> _block_maximum(np.array([[0, 3, 1], [0, 0, 2]]), 2).tolist()
    [[3, 2]]
    """
    starts = (np.arange(0, side, step) for side in image.shape)
    rows, columns = starts
    return np.asarray(np.maximum.reduceat(np.maximum.reduceat(image, rows, 0), columns, 1))
