"""The pictures that the viewer has of one layer: its render, other lights, single bands, maps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.srgb import encode_srgb, find_rendering
from levkas.core.cube import Band
from levkas.database.tiff_pages import open_pages
from levkas.viewer.maps import (
    Legend,
    blocks_of,
    flag_map,
    registration_map,
    sigma_map,
    similarity_map,
)
from levkas.viewer.relighting import ILLUMINANTS, relighting_matrix

if TYPE_CHECKING:
    from levkas.database.tiff_pages import TiffPages

MOST_BANDS = 64
"""Single bands shown of one layer; of more, so many at even distances."""
WHITE_PERCENTILE = 99.5
INFRARED_NM, RED_NM, GREEN_NM = (780, 1000, 900), (600, 700, 650), (500, 590, 550)
"""Least, most and wanted wavelength of false-colour infrared's three channels."""


@dataclass(frozen=True, eq=False)
class Picture:
    """One picture of a layer.

    Parameters
    ----------
    key : str
        Name within the layer, safe in paths and addresses.
    label, note : str
        What it is called, and what its colours mean.
    kind : str
        ``"colour"``, ``"light"``, ``"band"`` or ``"map"``.
    image : ndarray, (height, width) or (height, width, 3), uint8
    palette, legend : optional
        Of a map.
    """

    key: str
    label: str
    kind: str
    image: np.ndarray
    note: str = ""
    palette: np.ndarray | None = None
    legend: Legend | None = None


@dataclass(frozen=True)
class Source:
    """Where a layer's files are, and what is known of it."""

    database: Path
    object: str
    tiff: Path
    bands: tuple[Band, ...]
    quantity: str
    record: dict[str, Any]
    rendering: str = ""
    reference: Path | None = None

    @property
    def flags(self) -> Path:
        """The flags beside the TIFF."""
        return self.tiff.with_name(self.tiff.stem + ".flags.tif")

    @property
    def sigma(self) -> Path:
        """Sigma beside the TIFF; it may not be there."""
        return self.tiff.with_name(self.tiff.stem + ".sigma.tif")


def pictures_of(source: Source) -> Iterator[Picture]:
    """Yield every picture of a layer, one in memory at a time: render first, then lights, bands, maps."""
    pages = open_pages(source.tiff)
    render = pages.read_render()
    if render is not None:
        yield Picture("colour", "Colour", "colour", render, source.rendering)
    chosen = infrared_bands(source.bands)
    if chosen:
        labels = " / ".join(source.bands[i].label for i in chosen)
        image = np.stack([shown_band(pages.read_page(i))[0] for i in chosen], -1)
        note = f"{labels} as red, green and blue"
        yield Picture("infrared", "False-colour infrared", "colour", image, note)
    yield from _lights(source, pages)
    yield from _bands(source, pages)
    yield from _maps(source, (pages.shape[1], pages.shape[0]))


def infrared_bands(bands: tuple[Band, ...]) -> list[int] | None:
    """Choose infrared, red and green; None where one of them is missing.

    >>> infrared_bands(tuple(Band(f"{w} nm", w) for w in range(400, 701, 100)))
    >>> infrared_bands(tuple(Band(f"{w} nm", w) for w in range(400, 1001, 50)))
    [10, 5, 3]
    >>> infrared_bands((Band("R1"), Band("G1"), Band("B1"), Band("IR")))
    [3, 0, 1]
    """
    chosen = []
    for low, high, wanted in (INFRARED_NM, RED_NM, GREEN_NM):
        inside = [i for i, band in enumerate(bands) if low <= band.wavelength <= high]
        if not inside:
            return _infrared_channels([band.label for band in bands])
        chosen.append(min(inside, key=lambda i: (abs(bands[i].wavelength - wanted), i)))
    return chosen


def _infrared_channels(labels: list[str]) -> list[int] | None:
    starts = ("IR", "R", "G")
    found = [next((i for i, t in enumerate(labels) if t.startswith(s)), None) for s in starts]
    return None if None in found else [i for i in found if i is not None]


def shown_band(values: np.ndarray) -> tuple[np.ndarray, float]:
    """Return one band for the eye, uint8, and the value that is shown as white.

    Black is 0; white the 99.5 % point of a regular sample, so that dark bands can be read too.
    """
    step = max(1, int((values.size / 1_000_000) ** 0.5))
    sample = values[::step, ::step]
    finite = sample[np.isfinite(sample)]
    white = float(np.percentile(finite, WHITE_PERCENTILE)) if finite.size else 1.0
    white = float(f"{white:.2g}") if white > 0 else 1.0
    return encode_srgb(values / np.float32(white)), white


def _lights(source: Source, pages: TiffPages) -> Iterator[Picture]:
    """Yield the layer under other illuminants, where its bands are narrow and show true colour."""
    wavelengths = [band.wavelength for band in source.bands]
    if source.quantity != "reflectance" or not np.all(np.isfinite(wavelengths)):
        return
    if len(wavelengths) < 3 or not find_rendering(source.bands).colour:
        return
    for name, words in ILLUMINANTS.items():
        matrix = relighting_matrix(wavelengths, name)
        image = np.empty((*pages.shape[:2], 3), np.uint8)
        for rows in blocks_of(pages):
            some = pages.read(rows.start, rows.stop)
            linear = np.stack([np.einsum("yxb,b->yx", some, gain) for gain in matrix.T.copy()], -1)
            image[rows] = encode_srgb(linear)
        note = "as seen by an eye that is used to this light: white stays white"
        yield Picture(f"light-{name.lower()}", words, "light", image, note)


def _bands(source: Source, pages: TiffPages) -> Iterator[Picture]:
    count = len(source.bands)
    wanted = min(count, MOST_BANDS)
    for number in sorted({round(i * (count - 1) / max(1, wanted - 1)) for i in range(wanted)}):
        image, white = shown_band(pages.read_page(number))
        label = source.bands[number].label
        note = f"black is 0, white is {source.quantity or 'value'} {white:g}"
        yield Picture(f"band-{number}", label, "band", image, note)


def _maps(source: Source, size: tuple[int, int]) -> Iterator[Picture]:
    if source.flags.is_file():
        image, palette, legend = flag_map(source.flags)
        note = "the gravest flag of any band"
        yield Picture("flags", "Flags", "map", image, note, palette, legend)
    if source.sigma.is_file():
        image, legend = sigma_map(source.sigma)
        note = f"one standard deviation of the random part, mean of the bands, {source.quantity}"
        yield Picture("sigma", "Sigma", "map", image, note, legend=legend)
    if source.reference is not None and source.reference != source.tiff:
        found = similarity_map(source.tiff, source.reference)
        if found:
            note = "SSIM against the reference camera; gold and glare differ between cameras"
            yield Picture("ssim", "Similarity (SSIM)", "map", found[0], note, legend=found[1])
    predicted = registration_map(source.database, source.object, source.record, size)
    if predicted:
        note = "error of the registration as its own evidence predicts it"
        yield Picture("error", "Registration error", "map", predicted[0], note, legend=predicted[1])
