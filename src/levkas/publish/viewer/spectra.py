"""Numbers behind the pictures as script files, readable from file://: spectra and native positions.

A tile of spectra is the bytes of its float32 values (and sigma), split into byte planes and differenced
along x so that they compress, then zlib and base64. Nothing is rounded: the page shows the very numbers
of the TIFF.

The map to native pixels is sampled every few pixels of the grid, and the page interpolates it by cubic
(Catmull-Rom) splines. The lattice is made finer until that differs from the map itself by no more than
`WANTED_PX` between nodes."""

from __future__ import annotations

import base64
import json
import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.database.pixel_frames import Frame, FramePixels, MappingRefused, Records
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


def write_spectra(write: Write, folder: str, tiff: Path, *, key: str) -> dict[str, Any]:
    """Write the spectra of one layer, and return what a page needs.

    Parameters
    ----------
    write : callable
        ``write(name, data)``.
    folder : str
    tiff : Path
        Of the values; flags and sigma lie beside it.
    key : str
        Under which a tile announces itself, with its column and row.

    Returns
    -------
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
        whole = values.read(*rows)
        spread, marks = (part.read(*rows) if part else None for part in (sigma, flags))
        for column in range(-(-width // across)):
            span = slice(column * across, (column + 1) * across)
            parts = (whole, spread, marks)
            payload = b"".join(encode_block(p[:, span]) for p in parts if p is not None)
            text = base64.b64encode(zlib.compress(payload, ZLIB_LEVEL)).decode("ascii")
            call = f'levkasTile({json.dumps(f"{key}/{column}_{row}")},"{text}");\n'
            write(f"{folder}/{column}_{row}.js", call.encode("ascii"))
    return {
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


STEPS_PX = (64, 32, 16, 8, 4)

WANTED_PX = 0.01

PROBES = (0.25, 0.5)
"""Where between nodes the difference is taken: midway alone, a cubic's own would be nought."""


def write_lattices(
    write: Write, name: str, database: Path, item: str, frame: Frame, labels: list[str], *, key: str
) -> dict[str, Any] | None:
    """Write where each band of a layer recorded each pixel of the grid, as a script file.

    Returns
    -------
    record : dict or None
        step (px), error (px, the largest between nodes), columns, rows; None where there is no map.
    """
    try:
        records = Records(database, item)
        grid, reference = records.pixels(Frame()), records.reference()
        bands = [records.pixels(Frame(frame.camera, frame.setup, label)) for label in labels]
    except MappingRefused:
        return None
    if grid.size is None:
        return None
    for step in STEPS_PX:
        nodes, shape = nodes_of(grid.size, step)
        tables = [_sample(grid, band, nodes).reshape(*shape, 2) for band in bands]
        corners = nodes.reshape(*shape, 2)[1:-2, 1:-2].reshape(-1, 2)
        error = max(
            _largest(interpolate(table, t).reshape(-1, 2) - _sample(grid, band, corners + t * step))
            for table, band in zip(tables, bands, strict=True)
            for t in PROBES
        )
        if error <= WANTED_PX:
            break
    payload = {
        "reference": _encode(_sample(grid, reference, nodes)),
        "reference_size": reference.size,
        "bands": [
            {"size": band.size, "nodes": _encode(table)}
            for band, table in zip(bands, tables, strict=True)
        ],
    }
    call = f"levkasTile({json.dumps(key)},{json.dumps(payload)});\n"
    write(name, call.encode("ascii"))
    return {"step": step, "error": round(error, 5), "columns": shape[1], "rows": shape[0]}


def nodes_of(size: tuple[float, float], step: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Return the lattice's points, (n, 2), and its (rows, columns): one node beyond every side.

    >>> nodes_of((3, 2), 4)[0][0].tolist(), nodes_of((3, 2), 4)[1]
    ([-4.0, -4.0], (4, 4))
    """
    columns, rows = (int(-(-(n - 1) // step)) + 3 for n in size)
    x, y = np.meshgrid(np.arange(columns) - 1.0, np.arange(rows) - 1.0)
    return np.stack([x.ravel(), y.ravel()], 1) * step, (rows, columns)


def interpolate(table: np.ndarray, t: float) -> np.ndarray:
    """Interpolate (rows, columns, 2) at the fraction `t` between inner nodes, in both directions.

    >>> interpolate(np.arange(32.0).reshape(4, 4, 2), 0.5).tolist()
    [[[15.0, 16.0]]]
    """
    weights = np.array(
        [-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2]
    )
    rows = sum(w * table[i : len(table) - 3 + i] for i, w in enumerate(weights / 2))
    whole: np.ndarray = sum(
        w * rows[:, i : rows.shape[1] - 3 + i] for i, w in enumerate(weights / 2)
    )
    return whole


def _sample(grid: FramePixels, band: FramePixels, points: np.ndarray) -> np.ndarray:
    return band.from_reference(grid.from_reference.inverse(points))


def _largest(apart: np.ndarray) -> float:
    norms = np.hypot(apart[:, 0], apart[:, 1])
    return float(np.max(norms, initial=0.0, where=np.isfinite(norms)))


def _encode(table: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(table, "<f4").tobytes()).decode("ascii")
