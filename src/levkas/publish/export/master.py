"""Masters for archives and prints: 16-bit RGB under D50 with an embedded profile, as Metamorfoze and FADGI ask."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.files import replacing
from levkas.core.problems import Problem
from levkas.publish.export.layer import ExportLayer, ExportRefused

MOST_BYTES = 4_000_000_000
BLOCK_BYTES = 1 << 28
LEAST_COVERAGE = 0.9
"""Of the visible weight."""


def write_ecirgb(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM_ecirgb.tif: eciRGB v2, whose curve is L*."""
    return _write(layer, folder, "ecirgb")


def write_prophoto(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM_prophoto.tif: ProPhoto RGB, which holds every colour of a surface."""
    return _write(layer, folder, "prophoto")


def _write(layer: ExportLayer, folder: Path, space: str) -> list[Path]:
    """Write one master, uncompressed, with its sampling.

    Raises
    ------
    ExportRefused
        ``E_VALUE`` for a layer that has no colours: counts, broad channels, bands that do not reach through the visible.
    """
    import tifffile

    from levkas.colour.srgb import visible_coverage, xyz_weights
    from levkas.colour.working_spaces import D50, SPACES

    nm = layer.wavelengths
    if not nm or layer.quantity != "reflectance" or visible_coverage(nm) < LEAST_COVERAGE:
        span = f"{min(nm):g} to {max(nm):g} nm" if nm else "broad channels"
        raise ExportRefused(
            Problem(
                "E_VALUE",
                f"{layer.stem} has no colours to make a master of",
                str(layer.path),
                found=f"{layer.quantity}, {span}",
                expected="reflectance of narrow bands through the visible",
                fix="Choose a camera with --camera.",
            )
        )
    layer.limit_bytes(MOST_BYTES, space, "envi")
    weights = xyz_weights(nm, "D50")
    weights = weights / weights.sum(0) * D50
    picture = np.empty((*layer.shape[:2], 3), np.uint16)
    row = 0
    for rows in layer.rows("values", BLOCK_BYTES):
        # einsum, unlike a matrix product, sums in one order for any number of threads.
        xyz = np.stack([np.einsum("yxb,b->yx", rows.astype(float), w) for w in weights.T], -1)
        picture[row : row + len(rows)] = SPACES[space].encode(xyz)
        row += len(rows)
    path = folder / f"{layer.stem}_{space}.tif"
    scale = layer.px_per_mm
    sampling: dict[str, Any] = (
        {"resolution": (10 * scale, 10 * scale), "resolutionunit": "centimeter"} if scale else {}
    )
    with replacing(path) as handle:
        tifffile.imwrite(
            handle, picture, byteorder="<", photometric="rgb", metadata=None, software="Levkas",
            iccprofile=SPACES[space].profile(), description=f"{layer.stem}, {SPACES[space].name}, D50", **sampling,
        )  # fmt: skip
    return [path]
