"""MATLAB and Octave: one MAT-file (version 5) a layer, with cube, wavelengths, flags and sigma."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.files import replacing
from levkas.publish.export.layer import ExportLayer

MOST_BYTES = 2_000_000_000
"""Of a variable, in version 5."""
HEADER = b"MATLAB 5.0 MAT-file, written by levkas"
"""Of 116 bytes; scipy writes the time there."""
NAMES = {"values": "cube", "flags": "flags", "sigma": "sigma"}


def write_matlab(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.mat.

    Variables: ``cube`` (height, width, bands) single, ``wavelengths`` (1, bands) nm, NaN where
    channels are broad, ``fwhm``, ``bands`` a cell of labels, ``flags`` uint8, ``sigma`` single,
    ``quantity``, ``object``, ``camera``, ``setup``, ``px_per_mm``.

    Raises
    ------
    ExportRefused
        Beyond 2 GB.
    """
    from scipy.io import savemat

    layer.limit_bytes(MOST_BYTES, "MATLAB's version 5", "envi")
    variables: dict[str, Any] = {
        "wavelengths": np.array([[band.wavelength for band in layer.bands]]),
        "fwhm": np.array([[band.fwhm for band in layer.bands]]),
        "bands": np.array([layer.labels], dtype=object),
        "quantity": layer.quantity,
        "object": layer.object,
        "camera": layer.camera,
        "setup": layer.setup,
        "px_per_mm": float("nan") if layer.px_per_mm is None else layer.px_per_mm,
    }
    variables |= {NAMES[kind]: layer.whole(kind) for kind in layer.kinds}
    path = folder / f"{layer.stem}.mat"
    with replacing(path) as handle:
        savemat(handle, variables, do_compression=True, oned_as="row")
        handle.seek(0)
        handle.write(HEADER.ljust(116))
    return [path]
