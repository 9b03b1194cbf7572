"""Control points that people set: our own CSV, landmarks of BigWarp and points of the QGIS georeferencer.

Pixel centres are integers here, and y points down, as in BigWarp. QGIS counts from the corner of the first pixel, y upwards:
its centre is (0.5, -0.5). Taking one for the other moves a picture by half a pixel; between two cameras of a
different sampling the half pixels do not even cancel: 0.5 px of a 3900 px wide picture and 0.5 px of
a 1392 px wide one differ by 0.5·(1 − 1392/3900) = 0.32 px of the reference.

*Our CSV*: ``reference_x,reference_y,x,y,enabled,check``. Only the four coordinates are required; columns may stand in any
order and others are passed over.

*BigWarp* (Fiji): CSV without a header, every cell in quotes: name, active, moving x, y, fixed x, y; a volume has z after each y. Some
builds put an integer id after `active`. Coordinates are physical units of the picture, which is pixels where it has
no calibration, with the centre of the first pixel at 0 (ImgLib2). A point that was set in one picture
only has ``Infinity`` in the other and is left out. Source: ``LandmarkTableModel`` of https://github.com/saalfeldlab/bigwarp.

*QGIS* (`.points`), versions 2 and 3: a line ``#CRS: …`` (since 3.24), a header ``mapX,mapY,sourceX,sourceY,enable,dX,dY,residual``
(before 3.24 ``pixelX,pixelY``), then a row a point.
The source is the picture to register, in pixels whose corners are integers, rows negative; the map is the reference, with the same
frame. A file whose map is a land survey is refused. Sources: https://github.com/qgis/QGIS/pull/46415 and /issues/33607.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.problems import Problem, Refused
from levkas.core.text import LARGEST_TABLE, TextRefused, check_file

PLACES = ("reference_x", "reference_y", "x", "y")
FRAME = ("object", "camera", "band")
MOST_POINTS = 100_000
LARGEST_COORDINATE = 1e7
#: Characters of a row; bytes of a line, where a reference system in a comment may be long.
LONGEST_LINE, LONGEST_TEXT_LINE = 4096, 4 * 4096
#: Of a file, empty ones and comments counted: they bound the work of reading it.
MOST_LINES = 4 * MOST_POINTS
BYTE_ORDER_MARK = b"\xef\xbb\xbf"


class PointsRefused(Refused):
    """Control points that cannot be read, written or used."""


def _refused(code: str, message: str, *details: Any, **named: Any) -> PointsRefused:
    return PointsRefused(Problem(code, message, *details, **named))


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Pairs of points in two frames; pixel centres are integers, y points down.

    Raises PointsRefused where lengths differ, or a value is not finite or too large.

    Examples
    --------
    >>> pairs = ControlPoints([[0, 0], [10, 5]], [[1, 2], [11, 7]])
    >>> len(pairs), pairs.enabled.all()
    (2, np.True_)
    """

    reference: Any  # these four are arrays once the value is made
    target: Any
    """`reference`, `target`: (n, 2). x, y of every pair in either frame, px."""
    enabled: Any = None
    """(n,). A pair that is not enabled is kept and never used."""
    check: Any = None
    """(n,). A check point measures and never fits."""

    def __post_init__(self) -> None:
        reference, target = (_pairs(v) for v in (self.reference, self.target))
        n = len(reference)
        columns = {
            "reference": reference,
            "target": target,
            "enabled": _column(self.enabled, n, True),
            "check": _column(self.check, n, False),
        }
        if n > MOST_POINTS or any(len(value) != n for value in columns.values()):
            found = ", ".join(f"{len(value)} {name}" for name, value in columns.items())
            expected = f"as many of each, at most {MOST_POINTS}"
            raise _refused("E_SIZE", "points do not pair up", found=found, expected=expected)
        for name in ("reference", "target"):
            wrong = ~np.all(np.abs(columns[name]) <= LARGEST_COORDINATE, axis=1)
            if wrong.any():
                row = int(wrong.argmax())
                raise _refused(
                    "E_VALUE",
                    f"point {row + 1} is not a valid position",
                    field=name,
                    found=columns[name][row].tolist(),
                    expected=f"finite numbers up to {LARGEST_COORDINATE:.0f}",
                )
        for name, value in columns.items():
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.reference)


def _pairs(values: object) -> np.ndarray:
    return np.array(values, np.float64).reshape(-1, 2)


def _column(values: Any, n: int, default: bool) -> np.ndarray:
    return np.full(n, default) if values is None else np.array(values, bool).reshape(-1)


# --- text files, each refused where it stands


def check_lines(data: bytes) -> None:
    """Refuse more lines than a file of points can need; raises PointsRefused."""
    if (lines := data.count(b"\n")) > MOST_LINES:
        raise unreadable(f"{lines} lines", f"at most {MOST_LINES}")


def decode(data: bytes) -> str:
    """Return a text in UTF-8, with or without a mark of its byte order.

    Raises PointsRefused where it is none, or has too many lines, or one that is too long.
    """
    check_lines(data)
    if (longest := max(map(len, data.split(b"\n")))) > LONGEST_TEXT_LINE:
        raise unreadable(f"a line of {longest} bytes", f"lines of at most {LONGEST_TEXT_LINE}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise unreadable(str(error), "text in UTF-8") from error


def rows(text: str) -> list[list[str]]:
    """Split a table into its rows that hold anything.

    Raises PointsRefused where a line is too long, or there are more rows than points may be.
    """
    table: list[list[str]] = []
    try:
        for row in csv.reader(io.StringIO(text, newline="")):
            if len(table) > MOST_POINTS + 100:
                raise unreadable("more rows", f"at most {MOST_POINTS} points")
            if sum(map(len, row)) > LONGEST_LINE and not row[0].startswith("#"):
                raise unreadable(
                    f"{sum(map(len, row))} characters", f"lines of at most {LONGEST_LINE}"
                )
            if any(cell.strip() for cell in row):
                table.append(row)
    except csv.Error as error:
        raise unreadable(str(error), "a table") from error
    return table


def number(cell: str, where: str) -> float:
    """Read one finite number; `where` says which, for the refusal."""
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise unreadable(f"{cell[:40]!r} in {where}", "a finite number")
    return value


def flag(cell: str) -> bool:
    """Read a switch: everything but 0, false, no and nothing is on."""
    return cell.strip().lower() not in ("0", "0.0", "false", "no", "off", "")


def unreadable(found: str, expected: str) -> PointsRefused:
    """Return the refusal of a file that does not hold what it should."""
    return _refused(
        "E_UNREADABLE", "control points cannot be read", found=found[:200], expected=expected
    )


# --- the three kinds of file


def _read_table(data: bytes) -> ControlPoints:
    return _of_rows(rows(decode(data)))


def _of_rows(table: list[list[str]]) -> ControlPoints:
    """Read the rows of our CSV, its header first."""
    head = [cell.strip() for cell in table[0]] if table else []
    if not set(PLACES) <= set(head):
        raise unreadable(",".join(head)[:80] or "nothing", ",".join(PLACES))
    body = table[1:]
    short = next((i for i, row in enumerate(body, start=2) if len(row) < len(head)), None)
    if short is not None:
        raise unreadable(f"too few columns in row {short}", f"{len(head)}")
    cells = {name: [row[i] for row in body] for i, name in enumerate(head)}
    x, y, u, v = ([number(c, name) for c in cells[name]] for name in PLACES)
    return ControlPoints(
        list(zip(x, y, strict=True)),
        list(zip(u, v, strict=True)),
        *([flag(c) for c in cells[n]] if n in cells else None for n in ("enabled", "check")),
    )


def format_points(points: ControlPoints) -> bytes:
    """Return our CSV; floats are written so that they are read back as they were."""
    lines = [",".join((*PLACES, "enabled", "check"))]
    for place, other, on, check in zip(
        points.reference.tolist(), points.target.tolist(), points.enabled, points.check, strict=True
    ):
        lines.append(",".join(map(str, (*place, *other, int(on), int(check)))))
    return ("\n".join(lines) + "\n").encode()


BIGWARP_COLUMNS = {6: (2, False), 7: (2, True), 8: (3, False), 9: (3, True)}


def _is_bigwarp(data: bytes) -> bool:
    first = next(iter(rows(decode(data[:4096].rpartition(b"\n")[0] or data[:4096]))), [])
    return len(first) in BIGWARP_COLUMNS and first[1].strip().lower() in ("true", "false")


def _read_bigwarp(data: bytes) -> ControlPoints:
    """Read landmarks; moving is the target, fixed the reference."""
    found, enabled = [], []
    for line, row in enumerate(rows(decode(data)), start=1):
        if len(row) not in BIGWARP_COLUMNS:
            raise unreadable(f"{len(row)} columns in line {line}", "6 (plane) or 8 (volume)")
        ndim, has_id = BIGWARP_COLUMNS[len(row)]
        cells = row[3:] if has_id else row[2:]
        if any("infinity" in cell.lower() for cell in cells):
            continue
        values = [number(cell, f"line {line}") for cell in cells]
        found.append([*values[:2], *values[ndim : ndim + 2]])
        enabled.append(flag(row[1]))
    return ControlPoints([v[2:] for v in found], [v[:2] for v in found], enabled)


QGIS_SCALE, QGIS_CENTRE = (1.0, -1.0), (0.5, -0.5)
"""Of x and y, and where the centre of the first pixel lies."""


def _is_qgis(data: bytes) -> bool:
    start = data[:4096].removeprefix(BYTE_ORDER_MARK)
    return start.startswith(b"#CRS") or is_header(start, ("mapX", "mapY"))


def _read_qgis(data: bytes) -> ControlPoints:
    """Read points; source is the target, map the reference."""
    lines = decode(data).splitlines()
    surveyed = any(re.match(r"#CRS:\s*\S", line) for line in lines[:1])
    _, *table = rows("\n".join(line for line in lines if not line.startswith("#"))) or [[]]
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
    reference, target = ((part - QGIS_CENTRE) * QGIS_SCALE for part in (place[:, :2], place[:, 2:]))
    return ControlPoints(reference, target, enabled)


KINDS = {
    "levkas": (lambda data: is_header(data, PLACES), _read_table),
    "bigwarp": (_is_bigwarp, _read_bigwarp),
    "qgis": (_is_qgis, _read_qgis),
}
"""Program → whether a file is its, and how it is read."""


def is_header(data: bytes, names: Collection[str]) -> bool:
    """Return whether the first line of a file names these columns."""
    first = data[:4096].removeprefix(BYTE_ORDER_MARK).split(b"\n")[0].decode("utf-8", "replace")
    return set(names) <= {cell.strip().strip('"') for cell in first.split(",")}


def sniff(data: bytes) -> str:
    """Return the program, a key of `KINDS`, of a file from its content; raises PointsRefused where it is of none.

    >>> sniff(b'"Pt-0","true","1","2","3","4"\\n')
    'bigwarp'
    """
    check_lines(data)
    for name, (recognises, _) in KINDS.items():
        try:
            if recognises(data):
                return name
        except PointsRefused:
            continue
    raise _refused(
        "E_UNREADABLE",
        "the format of these control points is unknown",
        found=repr(data[:40].decode("utf-8", "replace").splitlines()[:1])[1:-1] or "nothing",
        expected="a CSV of Levkas or BigWarp, or points of QGIS",
        fix="Write a CSV with the columns reference_x,reference_y,x,y; the centre of the first pixel is 0, 0.",
    )


def parse_points(data: bytes) -> ControlPoints:
    """Read control points from the content of a file, of whatever program; raises PointsRefused."""
    if len(data) > LARGEST_TABLE:
        raise _refused(
            "E_SIZE",
            "the file of control points is too large",
            found=f"{len(data) >> 20} MiB",
            expected=f"at most {LARGEST_TABLE >> 20} MiB",
        )
    return KINDS[sniff(data)][1](data)


def read_points(path: str | Path) -> ControlPoints:
    """Read control points from a file of any program; raises PointsRefused with the file."""
    try:
        return parse_points(_bytes(Path(path)))
    except PointsRefused as refused:
        raise _in_file(refused, path) from None


def _in_file(refused: PointsRefused, path: str | Path) -> PointsRefused:
    return PointsRefused(*(p if p.file else replace(p, file=str(path)) for p in refused.problems))


def _bytes(path: Path) -> bytes:
    try:
        check_file(path, "a file of control points")
        with path.open("rb") as file:
            data = file.read(LARGEST_TABLE + 1)
    except (TextRefused, OSError) as error:
        problems = getattr(error, "problems", None) or (
            Problem("E_UNREADABLE", "control points cannot be read", str(path), found=str(error)),
        )
        raise PointsRefused(*problems) from None
    return data


# --- points of several frames in one table


Frame = tuple[str, str, str]
"""(object, CAMERA or CAMERA@SETUP, band; empty for the camera's reference channel)"""
MOST_FRAMES = 5000
"""Of one table: each is read by itself."""


def is_table_of_frames(path: Path) -> bool:
    """Return whether a file is a CSV with the columns object and camera, and the four coordinates."""
    with path.open("rb") as file:
        return is_header(file.read(4096), {*PLACES, *FRAME[:2]})


def read_table_of_frames(path: Path) -> dict[Frame, ControlPoints]:
    """Read a CSV of several frames: object, camera, band (may be left out), and the columns of our CSV; raises PointsRefused."""
    try:
        head, *body = rows(decode(_bytes(path)))
        head = [cell.strip() for cell in head]
        places = [head.index(name) if name in head else None for name in FRAME]
        groups: dict[Frame, list[list[str]]] = {}
        for row in body:
            name, layer, band = (
                "" if p is None or p >= len(row) else row[p].strip() for p in places
            )
            groups.setdefault((name, layer, band), []).append(row)
            if len(groups) > MOST_FRAMES:
                raise _refused(
                    "E_SIZE",
                    "the table has points of too many frames",
                    field="object, camera, band",
                    found=f"more than {MOST_FRAMES}",
                    expected=f"at most {MOST_FRAMES}",
                    fix="Write a table for each camera.",
                )
        return {frame: _of_rows([head, *group]) for frame, group in groups.items()}
    except PointsRefused as refused:
        raise _in_file(refused, path) from None


def parse_frame(text: str) -> Frame:
    """Read OBJECT/CAMERA, OBJECT/CAMERA@SETUP or OBJECT/CAMERA:BAND.

    Examples
    --------
    >>> parse_frame("icon1/d80@45-degree:R")
    ('icon1', 'd80@45-degree', 'R')
    """
    name, slash, rest = text.partition("/")
    layer, _, band = rest.partition(":")
    if not (name and slash and layer):
        raise _refused(
            "E_VALUE",
            "this is not a frame of an object",
            field="frame",
            found=text,
            expected="OBJECT/CAMERA, OBJECT/CAMERA@SETUP:BAND",
        )
    return name, layer, band


def read_frames(
    path: Path, frame: str | None, layers: Collection[tuple[str, str]]
) -> dict[Frame, ControlPoints]:
    """Read check points of any kind.

    Raises PointsRefused.

    Parameters
    ----------
    path : Path
        A CSV of several frames, or a file of any program for one.
    frame : str, optional
        Which one, for the latter; not needed where there is only one.
    layers : collection of (object, layer)
        That there are.
    """
    if path.is_file() and is_table_of_frames(path):
        if frame is not None:
            why, expected = (
                "the table names its frames itself",
                "a file of one frame, or no --frame",
            )
            raise _refused("E_VALUE", why, str(path), "--frame", frame, expected)
        return read_table_of_frames(path)
    if frame is None and len(layers) != 1:
        program = sniff(path.read_bytes()[: 1 << 20]) if path.is_file() else ""
        raise _refused(
            "E_VALUE",
            "the object and camera of these points are unknown",
            file=str(path),
            found=f"a file of {program}" if program else "no such file",
            expected=", ".join("/".join(key) for key in layers),
            fix="Add --frame OBJECT/CAMERA, or write a CSV with the columns object and camera.",
        )
    name, layer, band = parse_frame(frame) if frame else (*next(iter(layers)), "")
    if (name, layer) not in layers:
        raise _refused(
            "E_VALUE",
            f"unknown layer {name}/{layer}",
            field="frame",
            found=frame,
            expected=", ".join("/".join(key) for key in layers),
        )
    return {(name, layer, band): read_points(path)}
