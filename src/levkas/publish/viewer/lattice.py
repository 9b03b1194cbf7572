"""Coarse lattices of native pixel positions, which a page interpolates.

A map is sampled every few pixels of the grid and interpolated by cubic (Catmull-Rom) splines. The
lattice is made finer until that differs from the map itself by no more than `WANTED_PX` between nodes.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.database.pixel_frames import Frame, FramePixels, MappingRefused, Records

if TYPE_CHECKING:
    from levkas.publish.viewer.pyramid import Write

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
