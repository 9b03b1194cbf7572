"""Control points that people set: our own CSV, landmarks of BigWarp and points of the QGIS georeferencer.

Pixel centres are integers here, and y points down, as in BigWarp. QGIS counts from the corner of the first pixel, y upwards: its centre is
(0.5, -0.5). Taking one for the other moves a picture by half a pixel; between two cameras of a different sampling the half pixels do not
even cancel: 0.5 px of a 3900 px wide picture and 0.5 px of a 1392 px wide one differ by 0.5·(1 − 1392/3900) = 0.32 px of the reference.

*Our CSV*: ``reference_x,reference_y,x,y,enabled,check``. Only the four coordinates are required; columns may stand in any order and
others are passed over. With ``object``, ``camera`` and ``band`` it is a table of several frames.

*BigWarp* (Fiji): CSV without a header, every cell in quotes: name, active, moving x, y, fixed x, y; a volume has z after each y. Some builds
put an integer id after `active`. Coordinates are physical units of the picture, which is pixels where it has no calibration, with the
centre of the first pixel at 0 (ImgLib2). A point that was set in one picture only has ``Infinity`` in the other and is left out. Source:
``LandmarkTableModel`` of https://github.com/saalfeldlab/bigwarp.

*QGIS* (`.points`), versions 2 and 3: a line ``#CRS: …`` (since 3.24), a header ``mapX,mapY,sourceX,sourceY,enable,dX,dY,residual`` (before 3.24
``pixelX,pixelY``), then a row a point. The source is the picture to register, in pixels whose corners are integers, rows negative; the
map is the reference, with the same frame. A file whose map is a land survey is refused. Sources: https://github.com/qgis/QGIS/pull/46415
and /issues/33607.
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
MOST_POINTS, MOST_FRAMES, LARGEST_COORDINATE = 100_000, 5000, 1e7
"""Points of a file, and frames of a table, each of which is read by itself; px."""
LONGEST_LINE, LONGEST_TEXT_LINE = 4096, 4 * 4096
"""Characters of a row; bytes of a line, where a reference system in a comment may be long."""
MOST_LINES = 4 * MOST_POINTS
"""Of a file, empty ones and comments counted: they bound the work of reading it."""
QGIS_SCALE, QGIS_CENTRE = (1.0, -1.0), (0.5, -0.5)
"""Of x and y, and where the centre of the first pixel lies."""
BIGWARP_COLUMNS = {6: (2, 2), 7: (3, 2), 8: (2, 3), 9: (3, 3)}
"""Columns of a row → where its coordinates begin, and of how many dimensions they are."""

Frame = tuple[str, str, str]
"""(object, CAMERA or CAMERA@SETUP, band; empty for the camera's reference channel)"""
Table = list[list[str]]


class PointsRefused(Refused):
    """Control points that cannot be read, written or used."""


def _refused(code: str, message: str, **named: Any) -> PointsRefused:
    return PointsRefused(Problem(code, message, **named))


def _unreadable(found: str, expected: str) -> PointsRefused:
    message = "control points cannot be read"
    return _refused("E_UNREADABLE", message, found=found[:200], expected=expected)


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
        columns = {
            name: np.array(getattr(self, name), np.float64).reshape(-1, 2)
            for name in ("reference", "target")
        }
        n = len(columns["reference"])
        for name, default in (("enabled", True), ("check", False)):
            given = getattr(self, name)
            columns[name] = np.full(n, default) if given is None else np.array(given, bool).ravel()  # type: ignore[assignment]
        if n > MOST_POINTS or any(len(value) != n for value in columns.values()):
            found = ", ".join(f"{len(value)} {name}" for name, value in columns.items())
            expected = f"as many of each, at most {MOST_POINTS}"
            raise _refused("E_SIZE", "points do not pair up", found=found, expected=expected)
        for name, value in columns.items():
            wrong = ~np.all(np.abs(value) <= LARGEST_COORDINATE, axis=tuple(range(1, value.ndim)))
            if wrong.any():
                row = int(wrong.argmax())
                raise _refused(
                    "E_VALUE",
                    f"point {row + 1} is not a valid position",
                    field=name,
                    found=value[row].tolist(),
                    expected=f"finite numbers up to {LARGEST_COORDINATE:.0f}",
                )
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.reference)


# --- files, each refused where it stands


def read_points(path: str | Path) -> ControlPoints:
    """Read control points from a file of any program; raises PointsRefused with the file."""
    try:
        return parse_points(_bytes(Path(path)))
    except PointsRefused as refused:
        raise _in_file(refused, path) from None


def parse_points(data: bytes) -> ControlPoints:
    """Read control points from the content of a file, of whatever program; raises PointsRefused."""
    if len(data) > LARGEST_TABLE:
        raise _refused(
            "E_SIZE",
            "the file of control points is too large",
            found=f"{len(data) >> 20} MiB",
            expected=f"at most {LARGEST_TABLE >> 20} MiB",
        )
    return KINDS[sniff(data)](_rows(data))


def sniff(data: bytes) -> str:
    """Return the program, a key of `KINDS`, of a file from its first lines; raises PointsRefused where it is of none.

    >>> sniff(b'"Pt-0","true","1","2","3","4"\\n')
    'bigwarp'
    """
    start = data[:4096].removeprefix(b"\xef\xbb\xbf").decode("utf-8", "replace")
    lines = [line for line in start.splitlines() if line.strip()]
    try:
        first = next(csv.reader(lines), [])
    except csv.Error:
        first = []
    names = {cell.strip() for cell in first}
    if set(PLACES) <= names:
        return "levkas"
    if start.startswith("#CRS") or {"mapX", "mapY"} <= names:
        return "qgis"
    if len(first) in BIGWARP_COLUMNS and first[1].strip().lower() in ("true", "false"):
        return "bigwarp"
    raise _refused(
        "E_UNREADABLE",
        "the format of these control points is unknown",
        found=repr(start[:40].splitlines()[:1])[1:-1] or "nothing",
        expected="a CSV of Levkas or BigWarp, or points of QGIS",
        fix="Write a CSV with the columns reference_x,reference_y,x,y; the centre of the first pixel is 0, 0.",
    )


def _rows(data: bytes) -> Table:
    """Split a table in UTF-8 into its rows that hold anything; refuse what no file of points can need."""
    if (lines := data.count(b"\n")) > MOST_LINES:
        raise _unreadable(f"{lines} lines", f"at most {MOST_LINES}")
    if (longest := max(map(len, data.split(b"\n")))) > LONGEST_TEXT_LINE:
        raise _unreadable(f"a line of {longest} bytes", f"lines of at most {LONGEST_TEXT_LINE}")
    table: Table = []
    try:
        for row in csv.reader(io.StringIO(data.decode("utf-8-sig"), newline="")):
            length = sum(map(len, row))
            if len(table) > MOST_POINTS + 100:
                raise _unreadable("more rows", f"at most {MOST_POINTS} points")
            if length > LONGEST_LINE and not row[0].startswith("#"):
                raise _unreadable(f"{length} characters", f"lines of at most {LONGEST_LINE}")
            if any(cell.strip() for cell in row):
                table.append(row)
    except UnicodeDecodeError as error:
        raise _unreadable(str(error), "text in UTF-8") from error
    except csv.Error as error:
        raise _unreadable(str(error), "a table") from error
    return table


def _number(cell: str, where: str) -> float:
    try:
        value = float(cell)
    except ValueError:
        value = float("nan")
    if not isfinite(value):
        raise _unreadable(f"{cell[:40]!r} in {where}", "a finite number")
    return value


def _flag(cell: str) -> bool:
    """Read a switch: everything but 0, false, no, off and nothing is on."""
    return cell.strip().lower() not in ("0", "0.0", "false", "no", "off", "")


def _read_table(table: Table) -> ControlPoints:
    """Read the rows of our CSV, its header first."""
    head = [cell.strip() for cell in table[0]] if table else []
    if not set(PLACES) <= set(head):
        raise _unreadable(",".join(head)[:80] or "nothing", ",".join(PLACES))
    short = next((i for i, row in enumerate(table) if len(row) < len(head)), None)
    if short is not None:
        raise _unreadable(f"too few columns in row {short + 1}", f"{len(head)}")
    cells = {name: [row[i] for row in table[1:]] for i, name in enumerate(head)}
    places = np.array([[_number(c, name) for c in cells[name]] for name in PLACES]).T
    flags = ([_flag(c) for c in cells[n]] if n in cells else None for n in ("enabled", "check"))
    return ControlPoints(places[:, :2], places[:, 2:], *flags)


def _read_bigwarp(table: Table) -> ControlPoints:
    """Read landmarks; moving is the target, fixed the reference."""
    places, enabled = [], []
    for line, row in enumerate(table, start=1):
        if len(row) not in BIGWARP_COLUMNS:
            raise _unreadable(f"{len(row)} columns in line {line}", "6 (plane) or 8 (volume)")
        first, ndim = BIGWARP_COLUMNS[len(row)]
        if any("infinity" in cell.lower() for cell in row[first:]):
            continue
        values = [_number(cell, f"line {line}") for cell in row[first:]]
        places.append([*values[ndim : ndim + 2], *values[:2]])
        enabled.append(_flag(row[1]))
    both = np.array(places, float).reshape(-1, 4)
    return ControlPoints(both[:, :2], both[:, 2:], enabled)


def _read_qgis(table: Table) -> ControlPoints:
    """Read points; source is the target, map the reference."""
    surveyed = re.match(r"#CRS:\s*\S", ",".join(table[0])) is not None
    body = [row for row in table if not row[0].startswith("#")][1:]
    short = next((i for i, row in enumerate(body) if len(row) < 4), None)
    if short is not None:
        expected = "at least mapX,mapY,sourceX,sourceY"
        raise _unreadable(f"{len(body[short])} columns in row {short + 1}", expected)
    values = [[_number(c, f"row {i}") for c in row[:4]] for i, row in enumerate(body, start=1)]
    places = np.array(values, float).reshape(-1, 4)
    if surveyed and len(places) and (places[:, 1] > 0).all():
        expected = "a reference picture without georeference"
        raise _unreadable("a map with a reference system of the earth", expected)
    reference, target = (
        (part - QGIS_CENTRE) * QGIS_SCALE for part in (places[:, :2], places[:, 2:])
    )
    return ControlPoints(reference, target, [len(row) < 5 or _flag(row[4]) for row in body])


KINDS = {"levkas": _read_table, "bigwarp": _read_bigwarp, "qgis": _read_qgis}
"""Program → how its rows are read."""


def format_points(points: ControlPoints) -> bytes:
    """Return our CSV; floats are written so that they are read back as they were."""
    columns = (points.reference.tolist(), points.target.tolist(), points.enabled, points.check)
    lines = [
        ",".join(map(str, (*place, *other, int(on), int(check))))
        for place, other, on, check in zip(*columns, strict=True)
    ]
    return ("\n".join([",".join((*PLACES, "enabled", "check")), *lines]) + "\n").encode()


def _in_file(refused: PointsRefused, path: str | Path) -> PointsRefused:
    return PointsRefused(*(p if p.file else replace(p, file=str(path)) for p in refused.problems))


def _bytes(path: Path) -> bytes:
    try:
        check_file(path, "a file of control points")
        with path.open("rb") as file:
            return file.read(LARGEST_TABLE + 1)
    except TextRefused as refused:
        raise PointsRefused(*refused.problems) from None
    except OSError as error:
        raise _unreadable(str(error), "a file that can be read") from None


# --- points of several frames in one table


def is_table_of_frames(path: Path) -> bool:
    """Return whether a file is a CSV with the columns object and camera, and the four coordinates."""
    with path.open("rb") as file:
        first = file.read(4096).split(b"\n")[0].decode("utf-8-sig", "replace")
    return {cell.strip().strip('"') for cell in first.split(",")} >= {*PLACES, *FRAME[:2]}


def read_table_of_frames(path: Path) -> dict[Frame, ControlPoints]:
    """Read a CSV of several frames: object, camera, band (may be left out), and the columns of our CSV; raises PointsRefused."""
    try:
        head, *body = _rows(_bytes(path))
        head = [cell.strip() for cell in head]
        places = [head.index(name) if name in head else len(head) for name in FRAME]
        groups: dict[Frame, Table] = {}
        for row in body:
            name, layer, band = (row[p].strip() if p < len(row) else "" for p in places)
            groups.setdefault((name, layer, band), [head]).append(row)
        if len(groups) > MOST_FRAMES:
            raise _refused(
                "E_SIZE",
                "the table has points of too many frames",
                field="object, camera, band",
                found=len(groups),
                expected=f"at most {MOST_FRAMES}",
                fix="Write a table for each camera.",
            )
        return {frame: _read_table(group) for frame, group in groups.items()}
    except PointsRefused as refused:
        raise _in_file(refused, path) from None


def read_frames(
    path: Path, frame: str | None, layers: Collection[tuple[str, str]]
) -> dict[Frame, ControlPoints]:
    """Read check points of any kind: a CSV of several frames, or a file of any program for one; raises PointsRefused.

    `frame` is OBJECT/CAMERA, OBJECT/CAMERA@SETUP or OBJECT/CAMERA:BAND of the latter, not needed where there is only one of the
    (object, layer) that there are.
    """
    known, several = ", ".join("/".join(key) for key in layers), False
    if path.is_file() and (several := is_table_of_frames(path)) and frame is None:
        return read_table_of_frames(path)
    name, layer = (frame or "").partition("/")[::2]
    if frame is None and len(layers) == 1:
        name, layer = next(iter(layers))
    layer, _, band = layer.partition(":")
    if several or (name, layer) not in layers:
        raise _refused(
            "E_VALUE",
            "the table names its frames itself"
            if several
            else "the layer of these points is unknown",
            file=str(path),
            field="--frame",
            found=frame,
            expected="no --frame" if several else known,
            fix="Name it by --frame OBJECT/CAMERA, or write a CSV with the columns object and camera.",
        )
    return {(name, layer, band): read_points(path)}
