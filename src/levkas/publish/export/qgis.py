"""QGIS and other readers by GDAL: one TIFF with a sample a band, labels, and a world file in mm."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from levkas.core.files import replacing, write_text
from levkas.database.spectral_tiff import encode_strip, strip_rows
from levkas.publish.export.layer import ExportLayer

METADATA, NODATA = 42112, 42113
"""GDAL's own tags: items of XML a band, and the value that means nothing is there."""
CLASSIC_LIMIT = 4_000_000_000


def write_qgis(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.tif and the same for flags and sigma, each with a world file (.tfw).

    The world file's unit is mm where the sampling is known, else pixels; y points up, as maps have it,
    and the centre of the top left pixel is at (0, 0).
    """
    written = []
    for kind in layer.kinds:
        path = folder / f"{layer.stem}{'' if kind == 'values' else f'_{kind}'}.tif"
        _write_bands(path, layer, kind)
        world = path.with_suffix(".tfw")
        write_text(world, spell_world(layer.px_per_mm))
        written += [path, world]
    return written


def spell_world(px_per_mm: float | None) -> str:
    """Return the six lines of a world file.

    >>> spell_world(4.0).split()
    ['0.25', '0.0', '0.0', '-0.25', '0.0', '0.0']
    """
    step = 1.0 if px_per_mm is None else 1 / px_per_mm
    return "".join(f"{number!r}\n" for number in (step, 0.0, 0.0, -step, 0.0, 0.0))


def spell_metadata(layer: ExportLayer) -> str:
    """Return GDAL's XML: the label of every band, and its wavelength and width where it has them."""
    items = [
        f'<Item name="{name}">{escape(_plain(value))}</Item>'
        for name, value in (("quantity", layer.quantity), ("layer", layer.stem))
    ]
    for number, band in enumerate(layer.bands):
        values: dict[str, Any] = {
            "DESCRIPTION": band.label,
            "wavelength": band.wavelength,
            "fwhm": band.fwhm,
        }
        for name, value in values.items():
            if value == value:
                role = ' role="description"' if name == "DESCRIPTION" else ""
                text = value if isinstance(value, str) else repr(float(value))
                items.append(
                    f"<Item name={quoteattr(name)} sample={quoteattr(str(number))}{role}>"
                    f"{escape(_plain(text))}</Item>"
                )
        if band.wavelength == band.wavelength:
            items.append(f'<Item name="wavelength_units" sample="{number}">nanometers</Item>')
    return f"<GDALMetadata>{''.join(items)}</GDALMetadata>"


def _write_bands(path: Path, layer: ExportLayer, kind: str) -> None:
    import tifffile

    height, width, count = layer.shape
    dtype = np.dtype("uint8" if kind == "flags" else "float32")
    rows = strip_rows(width, dtype)
    xml = spell_metadata(layer).encode("utf-8")
    tags: list[tuple[Any, ...]] = [(METADATA, "s", len(xml), xml, True)]
    if kind != "flags":
        tags.append((NODATA, "s", 4, b"nan\0", True))
    with (
        replacing(path) as handle,
        tifffile.TiffWriter(
            handle, bigtiff=4 * height * width * count > CLASSIC_LIMIT, byteorder="<"
        ) as tiff,
    ):
        tiff.write(
            _strips(layer, kind, rows),
            shape=(count, height, width),
            dtype=dtype,
            photometric="minisblack",
            planarconfig="separate" if count > 1 else None,
            compression="zlib",
            predictor=3 if dtype.kind == "f" else None,
            metadata=None,
            software=False,
            rowsperstrip=rows,
            extratags=tags,
        )


def _strips(layer: ExportLayer, kind: str, rows: int) -> Iterator[bytes]:
    for plane in layer.planes(kind):
        for y in range(0, len(plane), rows):
            yield encode_strip(np.ascontiguousarray(plane[y : y + rows]))


def _plain(text: str) -> str:
    return "".join(c if c >= " " and c != "\x7f" else " " for c in text)
