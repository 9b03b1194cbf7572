"""Spectra as script files, one a tile of pixels, readable from file:// bit for bit.

A tile's payload is the bytes of its float32 values (and sigma), split into byte planes and
differenced along x so that they compress, then zlib and base64. Nothing is rounded: the page shows
the very numbers of the TIFF.
"""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.database.tiff_pages import open_pages

if TYPE_CHECKING:
    from levkas.publish.viewer.pyramid import Write

EDGE_PX = 64
LARGE_PX = 4_000_000
"""From here on tiles are twice as long, so that there are not too many files."""
BYTES_A_VALUE = 9
"""Value, sigma and flags."""
MOST_TILE_BYTES, MOST_ROW_BYTES = 5_000_000, 256_000_000
"""Of one tile, and of a row of tiles in memory; cubes of very many bands get lower tiles."""
LOWEST_PX = 8
ZLIB_LEVEL = 6


def write_spectra(write: Write, folder: str, tiff: Path, *, key: str) -> Iterator[dict[str, Any]]:
    """Write the spectra of one layer, yielding nothing but, at the end, what a page needs.

    Parameters
    ----------
    write : callable
        ``write(name, data)``.
    folder : str
    tiff : Path
        Of the values; flags and sigma stand beside it.
    key : str
        Under which a tile announces itself, with its column and row.

    Yields
    ------
    record : dict
        columns and rows of a tile (px), width, height, bands, sigma and flags (whether they are there).
    """
    values = open_pages(tiff)
    beside = [tiff.with_name(tiff.stem + kind) for kind in (".sigma.tif", ".flags.tif")]
    sigma, flags = (open_pages(path) if path.is_file() else None for path in beside)
    height, width, bands = values.shape
    across, down = tile_shape(width, height, bands)
    for row in range(-(-height // down)):
        rows = (row * down, min(height, (row + 1) * down))
        parts = [part.read(*rows) if part else None for part in (values, sigma, flags)]
        for column in range(-(-width // across)):
            span = slice(column * across, (column + 1) * across)
            payload = b"".join(encode_block(p[:, span]) for p in parts if p is not None)
            text = base64.b64encode(zlib.compress(payload, ZLIB_LEVEL)).decode("ascii")
            call = f'levkasTile({json.dumps(f"{key}/{column}_{row}")},"{text}");\n'
            write(f"{folder}/{column}_{row}.js", call.encode("ascii"))
    yield {
        **{"columns": across, "rows": down, "width": width, "height": height, "bands": bands},
        **{"sigma": sigma is not None, "flags": flags is not None},
    }


def tile_shape(width: int, height: int, bands: int) -> tuple[int, int]:
    """Return columns and rows of a tile.

    >>> tile_shape(640, 480, 33), tile_shape(4000, 3000, 33), tile_shape(10000, 10000, 200)
    ((64, 64), (128, 128), (128, 8))
    """
    across = down = EDGE_PX if width * height < LARGE_PX else 2 * EDGE_PX
    pixel = bands * BYTES_A_VALUE
    while down > LOWEST_PX and (
        across * down * pixel > MOST_TILE_BYTES or width * down * pixel > MOST_ROW_BYTES
    ):
        down //= 2
    return across, down


def encode_block(block: np.ndarray) -> bytes:
    """Return a block's bytes, band by band: byte planes, differenced along x.

    Parameters
    ----------
    block : ndarray, (rows, columns, bands), float32 or uint8

    Examples
    --------
    >>> encode_block(np.array([[[1], [3], [2]]], np.uint8)).hex()
    '0102ff'
    """
    planes = np.ascontiguousarray(np.moveaxis(block, 2, 0))
    little = planes.astype(planes.dtype.newbyteorder("<"), copy=False)
    octets = little.view(np.uint8).reshape(*planes.shape, planes.dtype.itemsize)
    octets = np.moveaxis(octets, 3, 1)
    return np.diff(octets, axis=-1, prepend=np.uint8(0)).tobytes()


def decode_block(
    data: bytes, shape: tuple[int, int, int], dtype: np.dtype | type
) -> tuple[np.ndarray, bytes]:
    """Return the first block of a payload, and what follows it: what the page does, for its proof.

    Examples
    --------
    >>> block = np.array([[[0.5], [np.pi]]], np.float32)
    >>> bool((decode_block(encode_block(block), (1, 2, 1), np.float32)[0] == block).all())
    True
    """
    rows, columns, bands = shape
    kind = np.dtype(dtype)
    size = rows * columns * bands * kind.itemsize
    octets = np.frombuffer(data[:size], np.uint8).reshape(bands, kind.itemsize, rows, columns)
    whole = np.cumsum(octets, axis=-1, dtype=np.uint8)
    values = np.ascontiguousarray(np.moveaxis(whole, 1, 3)).view(kind.newbyteorder("<"))[..., 0]
    return np.moveaxis(values, 0, 2).astype(kind), data[size:]
