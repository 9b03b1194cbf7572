"""Points of the QGIS georeferencer (`.points`), as versions 1 to 3 write them.

A line ``#CRS: …`` (since 3.24), a header ``mapX,mapY,sourceX,sourceY,enable,dX,dY,residual`` (before
3.24 ``pixelX,pixelY``; the oldest files have none, or tabs between the columns), then a row a point.
The source is the picture to register: x from its left edge, y from its top edge *upwards*, so that
rows are negative, in pixels whose corners are integers. The map is the reference; as a picture
without georeference it has the same frame. A file whose map is a land survey is refused.
Sources: https://github.com/qgis/QGIS/pull/46415 and /issues/33607, and the documentation of QGIS,
"Georeferencer".
"""

from __future__ import annotations

import re

import numpy as np

from levkas.registration.control_points.points import (
    ControlPoints,
    decode,
    flag,
    number,
    rows,
    unreadable,
    write_rows,
)

HEADER = ["mapX", "mapY", "sourceX", "sourceY", "enable", "dX", "dY", "residual"]
SCALE, CENTRE = (1.0, -1.0), (0.5, -0.5)
"""Of x and y, and where the centre of the first pixel lies."""
_TITLE = re.compile(rb"^[ \t]*\"?map_?x\"?[ \t]*[,;\t ]", re.IGNORECASE | re.MULTILINE)
"""Nothing in it crosses a line: thousands of empty ones would be looked through from each of them."""


def recognises(data: bytes) -> bool:
    """Return whether there is the header, or the line of the reference system."""
    start = data[:65536].lstrip(b"\xef\xbb\xbf")
    return start.startswith(b"#CRS") or _TITLE.search(start) is not None


def read(data: bytes) -> ControlPoints:
    """Read points; source is the target, map the reference."""
    text = decode(data)
    lines = [line for line in text.splitlines() if line.strip()]
    surveyed = any(re.match(r"#CRS:\s*\S", line) for line in lines[:1])
    body = [line for line in lines if not line.startswith("#")]
    separator = next((s for s in (",", ";", "\t") if body and s in body[0]), None)
    if body and separator is None:
        body, separator = [",".join(line.split()) for line in body], ","
    table = rows("\n".join(body), separator or ",")
    if table and table[0][0].strip().lower().replace("_", "") == "mapx":
        table = table[1:]
    values, enabled = [], []
    for line, row in enumerate(table, start=1):
        if len(row) < 4:
            raise unreadable(
                f"{len(row)} columns in row {line}", "at least mapX,mapY,sourceX,sourceY"
            )
        values.append([number(cell, f"row {line}") for cell in row[:4]])
        enabled.append(flag(row[4]) if len(row) > 4 else True)
    place = np.array(values, float).reshape(-1, 4)
    if surveyed and len(place) and (place[:, 1] > 0).all():
        raise unreadable(
            "a map with a reference system of the earth", "a reference picture without georeference"
        )
    reference, target = ((part - CENTRE) * SCALE for part in (place[:, :2], place[:, 2:]))
    return ControlPoints(reference, target, enabled=enabled)


def write(points: ControlPoints) -> bytes:
    """Write points as QGIS 3.24 and later read them; no reference system is named."""
    reference, target = (p * SCALE + CENTRE for p in (points.reference, points.target))
    table = [
        [*map_xy, *source_xy, int(on), 0, 0, 0]
        for map_xy, source_xy, on in zip(
            reference.tolist(), target.tolist(), points.enabled, strict=True
        )
    ]
    return ("#CRS: \n" + write_rows([HEADER, *table])).encode()
