"""Spectra as CSV: a row a pixel, a column a band."""

from __future__ import annotations

import csv
import io
from math import ceil, sqrt
from pathlib import Path

import numpy as np

from levkas.core.files import write_text
from levkas.publish.export.layer import ExportLayer

MOST_SPECTRA = 10_000
"""Of one layer: pixels are taken at even steps."""


def write_spectra(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.csv: ``x,y,flags`` and a column a band; and STEM_sigma.csv with the same pixels.

    Pixels are those at even steps, at most 10,000, without those that some band did not see. ``flags``
    is the sum of the bits of all bands. Numbers are the shortest that give the same float32 again.
    """
    height, width, _ = layer.shape
    step = max(1, ceil(sqrt(height * width / MOST_SPECTRA)))
    half = step // 2
    values = np.stack([p[half::step, half::step] for p in layer.planes()], -1)
    flags = np.zeros(values.shape[:2], np.uint8)
    if "flags" in layer.kinds:
        for plane in layer.planes("flags"):
            flags |= plane[half::step, half::step]
    rows, columns = np.nonzero(np.isfinite(values).all(-1))
    places = [
        (int(c) * step + half, int(r) * step + half) for r, c in zip(rows, columns, strict=True)
    ]
    written = []
    for kind in ("values", "sigma"):
        if kind not in layer.kinds:
            continue
        chosen = values
        if kind == "sigma":
            chosen = np.stack([p[half::step, half::step] for p in layer.planes(kind)], -1)
        path = folder / f"{layer.stem}{'' if kind == 'values' else '_sigma'}.csv"
        write_text(path, _spell(layer, places, flags[rows, columns], chosen[rows, columns]))
        written.append(path)
    return written


def _spell(
    layer: ExportLayer, places: list[tuple[int, int]], flags: np.ndarray, spectra: np.ndarray
) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(["x", "y", "flags", *layer.labels])
    for (x, y), flag, spectrum in zip(places, flags, spectra, strict=True):
        table.writerow([x, y, int(flag), *(str(number) for number in spectrum)])
    return text.getvalue()
