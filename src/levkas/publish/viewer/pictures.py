"""Pictures of one layer in the viewer: its render, other illuminants, single bands, maps, analyses."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.relighting import relighting_matrix
from levkas.colour.srgb import encode_srgb, find_rendering
from levkas.core.cube import Band
from levkas.core.text import read_json
from levkas.database.registrations import shares_light
from levkas.database.tiff_pages import open_pages
from levkas.pages.maps import (
    Legend,
    blocks_of,
    colour_scale,
    flag_map,
    registration_map,
    sigma_map,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

    from levkas.database.tiff_pages import TiffPages


MOST_BANDS = 64
"""Single bands shown of one layer; of more, so many at even distances."""

WHITE_PERCENTILE = 99.5

INFRARED_NM, RED_NM, GREEN_NM = (780, 1000, 900), (600, 700, 650), (500, 590, 550)
"""Least, most and wanted wavelength of false-colour infrared's three channels."""


@dataclass(frozen=True, eq=False)
class LayerPicture:
    """One picture of a layer.

    Parameters
    ----------
    key : str
        Name within the layer, safe in paths and addresses.
    label, note : str
        What it is called, and what its colours mean.
    kind : str
        ``"colour"``, ``"light"``, ``"band"``, ``"map"`` or ``"analysis"``.
    image : ndarray, (height, width) or (height, width, 3), uint8
    palette, legend : optional
        Of a map.
    white : float, optional
        Of a single band: the value that is shown white; 0 is black.
    """

    key: str
    label: str
    kind: str
    image: np.ndarray
    note: str = ""
    palette: np.ndarray | None = None
    legend: Legend | None = None
    white: float | None = None


@dataclass(frozen=True)
class Source:
    """Files and metadata of a layer."""

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


def pictures_of(source: Source) -> Iterator[LayerPicture]:
    """Yield every picture of a layer, one in memory at a time: render first, then lights, bands, maps, analyses."""
    pages = open_pages(source.tiff)
    render = pages.read_render()
    if render is not None:
        yield LayerPicture("colour", "Colour", "colour", render, source.rendering)
    chosen = infrared_bands(source.bands)
    if chosen:
        labels = " / ".join(source.bands[i].label for i in chosen)
        image = np.stack([shown_band(pages.read_page(i))[0] for i in chosen], -1)
        note = f"{labels} as red, green and blue"
        yield LayerPicture("infrared", "False-colour infrared", "colour", image, note)
    yield from _lights(source, pages)
    yield from _bands(source, pages)
    yield from _maps(source, (pages.shape[1], pages.shape[0]))
    yield from _analyses(source)


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


def _lights(source: Source, pages: TiffPages) -> Iterator[LayerPicture]:
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
        note = "for an eye adapted to this light: white remains white"
        yield LayerPicture(f"light-{name.lower()}", words, "light", image, note)


def _bands(source: Source, pages: TiffPages) -> Iterator[LayerPicture]:
    count = len(source.bands)
    wanted = min(count, MOST_BANDS)
    for number in sorted({round(i * (count - 1) / max(1, wanted - 1)) for i in range(wanted)}):
        image, white = shown_band(pages.read_page(number))
        label = source.bands[number].label
        note = f"black is 0, white is {source.quantity or 'value'} {white:g}"
        yield LayerPicture(f"band-{number}", label, "band", image, note, white=white)


def analyses_of(tiff: Path) -> list[Path]:
    """Return the records of a layer's analyses."""
    found = sorted(tiff.with_name(ANALYSES).glob("*.json"))
    return [path for path in found if path.name.startswith(f"{tiff.stem}.")]


def _analyses(source: Source) -> Iterator[LayerPicture]:
    """Yield what was computed from the layer when the database was published, in grey."""
    for path in analyses_of(source.tiff):
        record, name = read_json(path), path.name[len(source.tiff.stem) + 1 : -len(".json")]
        pages = open_pages(path.with_name(record["file"]))
        for number, shown in enumerate(record["pictures"]):
            black, white = shown["black"], shown["white"]
            image = shown_grey(pages.read_page(number), black, white)
            many = f"-{number + 1}" if len(pages) > 1 else ""
            ends = (f"{end:g}".replace("-", "−") for end in (black, white))
            legend = Legend(GREYS, *ends)
            note = f"{shown['note']} Violet: a flag makes the pixel unusable."
            key, label = f"{name}{many}", shown["label"]
            yield LayerPicture(key, label, "analysis", image, note, legend=legend)


def shown_grey(values: np.ndarray, black: float, white: float) -> np.ndarray:
    """Return numbers as greys between two of them, uint8 (…, 3); NaN is violet.

    >>> shown_grey(np.array([-1.0, 0.0, 1.0, np.nan]), -1, 1)[:, :].tolist()
    [[0, 0, 0], [128, 128, 128], [255, 255, 255], [118, 84, 158]]
    """
    known = np.isfinite(values)
    span = white - black if white > black else 1.0
    place = np.clip(np.where(known, (values - black) / span, 0), 0, 1)
    grey = np.round(255 * place).astype(np.uint8)[..., None]
    return np.where(known[..., None], grey, np.array(UNUSABLE, np.uint8))


def _maps(source: Source, size: tuple[int, int]) -> Iterator[LayerPicture]:
    if source.flags.is_file():
        image, palette, legend = flag_map(source.flags)
        note = "the most serious flag of any band"
        yield LayerPicture("flags", "Flags", "map", image, note, palette, legend)
    if source.sigma.is_file():
        image, legend = sigma_map(source.sigma)
        note = f"one standard deviation of the random part, mean of the bands, or of every n-th of more than 24, {source.quantity}"
        yield LayerPicture("sigma", "Sigma", "map", image, note, legend=legend)
    compared = source.reference is not None and source.reference != source.tiff
    if compared and shares_light(source.record, [band.wavelength for band in source.bands]):
        assert source.reference is not None
        found = similarity_map(source.tiff, source.reference)
        if found:
            note = "SSIM against the reference camera; gold and glare differ between cameras"
            yield LayerPicture("ssim", "Similarity (SSIM)", "map", found[0], note, legend=found[1])
    predicted = registration_map(source.record, size)
    if predicted:
        note = "predicted error of the registration; grey where the map was not checked"
        yield LayerPicture(
            "error", "Registration error", "map", predicted[0], note, legend=predicted[1]
        )


ANALYSES = "analysis"
"""Folder beside a layer, of what was computed from it."""
GREYS = (("", (0, 0, 0)), ("", (255, 255, 255)))
UNUSABLE = (118, 84, 158)
"""No grey, so that nobody takes it for a value."""
MOST_BYTES_SSIM = 2_000_000_000


def similarity_map(tiff: Path, reference: Path) -> tuple[np.ndarray, Legend] | None:
    """Return the SSIM of a layer against the reference camera's, or None where it is not defined."""
    from levkas.database.grey import read_grey
    from levkas.quality.evaluation.similarity import structural_similarity

    sizes = [int(np.prod(open_pages(path).shape)) * 4 for path in (tiff, reference)]
    if max(sizes) > MOST_BYTES_SSIM:
        return None
    (target, valid), (other, there) = read_grey(tiff), read_grey(reference)
    if target.shape != other.shape:
        return None
    score, full = structural_similarity(other, target, valid & there)
    if np.isnan(score):
        return None
    return colour_scale(full, 0.0, 1.0), Legend(least="0", most="1, alike")


ILLUMINANTS = {
    "D50": "D50, daylight in the morning",
    "A": "A, incandescent lamp",
    "LED-B3": "LED-B3, white LED of 4100 K",
    "FL2": "FL2, fluorescent tube",
}
"""CIE illuminants beside D65, and what they are."""
