"""Landmarks of BigWarp (Fiji): CSV without a header, every cell in quotes.

Columns: name, active, moving x, y, fixed x, y; a volume has z after each y. Some builds put an
integer id after `active`. Coordinates are physical units of the picture, which is pixels where it has
no calibration, with the centre of the first pixel at 0 (ImgLib2). A point that was set in one picture
only has ``Infinity`` in the other and is left out.
Source: ``LandmarkTableModel`` of https://github.com/saalfeldlab/bigwarp (`save`, `loadCsv`).
"""

from __future__ import annotations

from levkas.registration.control_points.points import (
    ControlPoints,
    decode,
    flag,
    number,
    rows,
    unreadable,
    write_rows,
)

COLUMNS = {6: (2, False), 7: (2, True), 8: (3, False), 9: (3, True)}


def recognises(data: bytes) -> bool:
    """Return whether the first row is a name, true or false, and numbers."""
    first = next(iter(rows(decode(data[:4096].rpartition(b"\n")[0] or data[:4096]))), [])
    return len(first) in COLUMNS and first[1].strip().lower() in ("true", "false")


def read(data: bytes) -> ControlPoints:
    """Read landmarks; moving is the target, fixed the reference."""
    found: list[tuple[str, bool, list[float]]] = []
    for line, row in enumerate(rows(decode(data)), start=1):
        if len(row) not in COLUMNS:
            raise unreadable(f"{len(row)} columns in line {line}", "6 (plane) or 8 (volume)")
        ndim, has_id = COLUMNS[len(row)]
        cells = row[3:] if has_id else row[2:]
        if any("infinity" in cell.lower() for cell in cells):
            continue
        values = [number(cell, f"line {line}") for cell in cells]
        found.append((row[0], flag(row[1]), [*values[:2], *values[ndim : ndim + 2]]))
    return ControlPoints(
        [v[2:] for _, _, v in found],
        [v[:2] for _, _, v in found],
        names=tuple(name for name, _, _ in found),
        enabled=[on for _, on, _ in found],
    )


def write(points: ControlPoints) -> bytes:
    """Write landmarks of a plane."""
    table = [
        [name, "true" if on else "false", *target, *reference]
        for name, on, target, reference in zip(
            points.names,
            points.enabled,
            points.target.tolist(),
            points.reference.tolist(),
            strict=True,
        )
    ]
    return write_rows(table, quote=True).encode()
