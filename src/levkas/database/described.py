"""What the spectral TIFF of a layer says of itself, and its pixels some rows at a time, as plain arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import nan
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from levkas.core.cube import Band, band_labels
from levkas.core.problems import Refused
from levkas.core.text import parse_json, read_text
from levkas.database.layout import KINDS, LayerId
from levkas.database.spectral_tiff import METADATA, WAVELENGTHS, decode_text
from levkas.database.tiff_pages import TiffPages, open_pages


@dataclass(frozen=True)
class Described:
    """What a layer's TIFF says of itself: its bands, and its other facts."""

    bands: tuple[Band, ...]
    facts: dict[str, Any]

    @property
    def quantity(self) -> str:
        """``"reflectance"``, ``"counts"``, ``"flags"`` …; ``"values"`` where it is not stated."""
        return str(self.facts.get("quantity", "values"))


def open_tiff(path: Path) -> Described:
    """Read what the spectral TIFF of a layer says of its bands; raises TiffRefused."""
    return describe_pages(open_pages(path))


def describe_pages(pages: TiffPages) -> Described:
    """Return what the pages' tags say."""
    text = decode_text(str(next((t for t in pages.tags(METADATA) if t), "")))
    centres = next((t for t in pages.tags(WAVELENGTHS) if t is not None), None)
    try:
        record = parse_json(text) if text else {}
    except ValueError:
        record = None
    if not isinstance(record, dict):
        record = {"metadata": text}
    labels, widths = record.pop("bands", None), record.pop("fwhm", None) or [None] * len(pages)
    known = record.pop("wavelength", None)
    bad = record.get("bad_bands") or ()
    if not labels or len(labels) != len(pages):
        values = [centres] if isinstance(centres, float) else list(centres or range(len(pages)))
        labels, known = band_labels(values), values
    bands = [
        Band(str(label), nan if nm is None else nm, nan if width is None else width, label in bad)
        for label, nm, width in zip(labels, known, widths, strict=True)
    ]
    return Described(tuple(bands), record)


def channel_shapes(database: Path, camera: str, labels: Sequence[str]) -> list[tuple[float, float]]:
    """Return centroid and full width at half maximum of channels, nm, by the published sensitivities; NaN if not known."""
    unknown = [(nan, nan)] * len(labels)
    try:
        text = read_text(database / "cameras" / camera / "sensitivity.csv", "sensitivities as CSV")
        head_line, *lines = text.splitlines()
        head = [cell.strip() for cell in head_line.split(",")]
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
    except (Refused, ValueError):
        return unknown
    columns = {label: table[:, i] for i, label in enumerate(head) if i and i < table.shape[1]}
    found = [columns.get(label) for label in labels]
    return [_shape(table[:, 0], c) if c is not None and c.sum() > 0 else (nan, nan) for c in found]


def _shape(wavelengths: np.ndarray, response: np.ndarray) -> tuple[float, float]:
    """Centroid and full width at half maximum of a response.

    >>> _shape(np.arange(400.0, 450.0, 10.0), np.array([0.0, 1.0, 1.0, 1.0, 0.0]))
    (420.0, 30.0)
    """
    half = response.max() / 2
    high = np.flatnonzero(response >= half)
    rise, fall = slice(max(high[0] - 1, 0), high[0] + 1), slice(high[-1], high[-1] + 2)
    start = float(np.interp(half, response[rise], wavelengths[rise]))
    end = float(np.interp(half, response[fall][::-1], wavelengths[fall][::-1]))
    return float((response * wavelengths).sum() / response.sum()), end - start


class Pixels(NamedTuple):
    """Some rows of a layer, each array (h, w, bands); `sigma` is None where noise is not known."""

    values: np.ndarray
    flags: np.ndarray
    sigma: np.ndarray | None

    def part(self, rows: slice, columns: slice) -> Pixels:
        return Pixels(*(None if a is None else a[rows, columns] for a in self))  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class LayerRows:
    """A published layer of the database `root`, read off its TIFFs of values, flags and, where noise is known, sigma."""

    root: Path
    layer: LayerId
    described: Described
    pages: dict[str, TiffPages]

    @classmethod
    def open(cls, root: Path, layer: LayerId) -> LayerRows:
        """Open a layer without reading a pixel; raises TiffRefused."""
        paths = {kind: root / (layer.path + ending) for kind, ending in KINDS.items()}
        known = {k: open_pages(p) for k, p in paths.items() if k != "sigma" or p.is_file()}
        return cls(root, layer, describe_pages(known["values"]), known)

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(self.pages["values"].shape)

    @property
    def bands(self) -> tuple[Band, ...]:
        return self.described.bands

    def read(self, start: int, stop: int) -> Pixels:
        known = {kind: pages.read(start, stop) for kind, pages in self.pages.items()}
        return Pixels(known["values"], known["flags"], known.get("sigma"))
