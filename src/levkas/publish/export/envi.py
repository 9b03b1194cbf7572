"""ENVI, Spectral Python, QGIS's EnMAP-Box: raw numbers band after band, with a header of text."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from levkas.core.files import replacing, write_text
from levkas.publish.export.layer import ExportLayer

TYPES = {"values": ("<f4", 4), "sigma": ("<f4", 4), "flags": ("u1", 1)}
"""Of the file, and ENVI's number for it."""


def write_envi(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.img with STEM.hdr, and the same for flags and sigma; float32, little-endian, BSQ."""
    written = []
    for kind in layer.kinds:
        path = folder / f"{layer.stem}{'' if kind == 'values' else f'_{kind}'}.img"
        dtype, number = TYPES[kind]
        with replacing(path) as handle:
            for plane in layer.planes(kind):
                handle.write(np.ascontiguousarray(plane, dtype).data)
        header = path.with_suffix(".hdr")
        write_text(header, spell_header(layer, kind, number))
        written += [path, header]
    return written


def spell_header(layer: ExportLayer, kind: str, number: int) -> str:
    """Return the text of a header; wavelengths only where the bands have centres."""
    height, width, count = layer.shape
    what = layer.quantity if kind == "values" else f"{kind} of {layer.quantity}"
    lines = [
        "ENVI",
        f"description = {{{_plain(f'{layer.stem}: {what}')}}}",
        f"samples = {width}",
        f"lines = {height}",
        f"bands = {count}",
        "header offset = 0",
        "file type = ENVI Standard",
        f"data type = {number}",
        "interleave = bsq",
        "byte order = 0",
        f"band names = {_listed(layer.labels)}",
    ]
    if kind != "flags":  # a flag of 0 is a sound value
        lines.append("data ignore value = NaN")
    if layer.wavelengths:
        lines.append("wavelength units = Nanometers")
        lines.append(f"wavelength = {_listed([repr(float(w)) for w in layer.wavelengths])}")
        widths = [band.fwhm for band in layer.bands]
        if all(w == w for w in widths):
            lines.append(f"fwhm = {_listed([repr(float(w)) for w in widths])}")
    if layer.px_per_mm:
        step = repr(1 / layer.px_per_mm)
        lines.append(f"pixel size = {{{step}, {step}, units=mm}}")
    return "\n".join(lines) + "\n"


def _listed(texts: Sequence[str]) -> str:
    return "{" + ", ".join(_plain(text).replace(",", ";") for text in texts) + "}"


def _plain(text: str) -> str:
    """Text without what ends a value of the header."""
    return re.sub(r"[{}\x00-\x1f\x7f]", " ", text)
