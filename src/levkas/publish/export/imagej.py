"""ImageJ and Fiji: a stack of bands without a picture before it, the labels of slices the bands'.

ImageJ opens only the first page of a TIFF whose pages differ, so that the spectral TIFF, with its RGB
page, cannot be a stack. Neither Deflate with a predictor nor BigTIFF is read by all its versions.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from levkas.core.files import replacing
from levkas.publish.export.layer import ExportLayer

MOST_BYTES = 4_000_000_000
"""Of a classic TIFF."""


def write_imagej(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.tif, STEM_flags.tif and STEM_sigma.tif, each a stack of slices.

    Raises
    ------
    ExportRefused
        Beyond 4 GB.
    """
    layer.limit_bytes(MOST_BYTES, "ImageJ's TIFF", "envi")
    written = []
    for kind in layer.kinds:
        path = folder / f"{layer.stem}{'' if kind == 'values' else f'_{kind}'}.tif"
        _write_stack(path, layer, kind)
        written.append(path)
    return written


def _write_stack(path: Path, layer: ExportLayer, kind: str) -> None:
    import tifffile

    height, width, count = layer.shape
    metadata: dict[str, Any] = {"axes": "ZYX", "Labels": layer.labels, "mode": "grayscale"}
    if kind == "values" and layer.quantity == "reflectance":
        metadata |= {"min": 0.0, "max": 1.0}  # how it is shown at first, nothing is clipped
    options: dict[str, Any] = {}
    if layer.px_per_mm:
        metadata["unit"] = "mm"
        options["resolution"] = (layer.px_per_mm, layer.px_per_mm)
    dtype = "uint8" if kind == "flags" else "float32"
    with replacing(path) as handle:
        tifffile.imwrite(
            handle,
            (plane for plane in layer.planes(kind)),
            shape=(count, height, width),
            dtype=dtype,
            imagej=True,
            metadata=metadata,
            software=False,
            **options,
        )
