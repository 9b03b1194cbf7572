"""MATLAB and Octave: one MAT-file (version 5) a layer, with cube, wavelengths, flags and sigma."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from levkas.core.files import replacing
from levkas.export.layer import ExportLayer

MOST_BYTES = 2_000_000_000
"""Of a variable, in version 5."""
HEADER = b"MATLAB 5.0 MAT-file, written by levkas"
"""Of 116 bytes; scipy writes the time there."""
LEVEL = 1
INT8, INT32, UINT32, MATRIX, COMPRESSED = 1, 5, 6, 14, 15
KINDS = {"float32": (7, 7), "uint8": (9, 2)}
"""numpy's type: MATLAB's class of an array, and its type of numbers in a file."""


def write_matlab(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.mat, band after band: MATLAB keeps columns together, then rows, then bands.

    Variables: ``cube`` (height, width, bands) single, ``wavelengths`` (1, bands) nm, NaN where
    channels are broad, ``fwhm``, ``bands`` a cell of labels, ``flags`` uint8, ``sigma`` single,
    ``quantity``, ``object``, ``camera``, ``setup``, ``px_per_mm``.

    Raises
    ------
    ExportRefused
        Beyond 2 GB.
    """
    layer.limit_bytes(MOST_BYTES, "MATLAB's version 5", "envi")
    path = folder / f"{layer.stem}.mat"
    with replacing(path) as handle:
        handle.write(encode_mat(variables_of(layer)))
        for kind in layer.kinds:
            _write_cube(handle, layer, kind)
    return [path]


def variables_of(layer: ExportLayer) -> dict[str, Any]:
    """Return the small variables of a layer's MAT-file."""
    return {
        "wavelengths": np.array([[band.wavelength for band in layer.bands]]),
        "fwhm": np.array([[band.fwhm for band in layer.bands]]),
        "bands": np.array([layer.labels], dtype=object),
        "quantity": layer.quantity,
        "object": layer.object,
        "camera": layer.camera,
        "setup": layer.setup,
        "px_per_mm": float("nan") if layer.px_per_mm is None else layer.px_per_mm,
    }


def encode_mat(variables: dict[str, Any]) -> bytes:
    """Return a MAT-file, the same bytes at any time."""
    from scipy.io import savemat

    target = io.BytesIO()
    savemat(target, variables, do_compression=True, oned_as="row")
    target.seek(0)
    target.write(HEADER.ljust(116))
    return target.getvalue()


def _write_cube(handle: BinaryIO, layer: ExportLayer, kind: str) -> None:
    """Append a cube as one compressed element; its length stands before it, and is known after it."""
    name = "cube" if kind == "values" else kind
    dtype = np.dtype(np.uint8 if kind == "flags" else np.float32)
    place = handle.tell()
    handle.write(struct.pack("<II", COMPRESSED, 0))
    squeeze = zlib.compressobj(LEVEL)
    size = layer.shape[0] * layer.shape[1] * layer.shape[2] * dtype.itemsize
    handle.write(squeeze.compress(_head(name, layer.shape, dtype, size)))
    for plane in layer.planes(kind):
        handle.write(squeeze.compress(np.ascontiguousarray(plane.T, dtype.newbyteorder("<")).data))
    handle.write(squeeze.compress(bytes(-size % 8)))
    handle.write(squeeze.flush())
    end = handle.tell()
    handle.seek(place)
    handle.write(struct.pack("<II", COMPRESSED, end - place - 8))
    handle.seek(end)


def _head(name: str, shape: tuple[int, int, int], dtype: np.dtype[Any], size: int) -> bytes:
    """The start of an array: its class, its size, its name, and how long its numbers are."""
    kind, numbers = KINDS[dtype.name]
    parts = [
        struct.pack("<IIII", UINT32, 8, kind, 0),
        struct.pack("<IIiii", INT32, 12, *shape) + bytes(4),
        struct.pack("<II", INT8, len(name)) + name.encode() + bytes(-len(name) % 8),
        struct.pack("<II", numbers, size),
    ]
    inside = b"".join(parts)
    return struct.pack("<II", MATRIX, len(inside) + size + -size % 8) + inside
