"""Control points: pairs of places in two pictures; the origins and the text files of other programs.

Pixel centres are integers here, and y points down, as in BigWarp. QGIS counts from the corner of the first pixel, y upwards:
its centre is (0.5, -0.5). Taking one for the other moves a picture by half a pixel; between two cameras of a
different sampling the half pixels do not even cancel: 0.5 px of a 3900 px wide picture and 0.5 px of
a 1392 px wide one differ by 0.5·(1 − 1392/3900) = 0.32 px of the reference.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np

from levkas.core.problems import Problem, Refused

MOST_POINTS = 100_000
LARGEST_COORDINATE = 1e7
LONGEST_NAME = 200
#: Characters of a row; bytes of a line, where a reference system in a comment may be long.
LONGEST_LINE, LONGEST_TEXT_LINE = 4096, 4 * 4096
#: Of a file, empty ones and comments counted: they bound the work of reading it.
MOST_LINES = 4 * MOST_POINTS


class PointsRefused(Refused):
    """Control points that cannot be read, written or used."""


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Pairs of points in two frames; pixel centres are integers, y points down.

    Parameters
    ----------
    reference, target : array_like, (n, 2)
        x, y of every pair in either frame, px.
    names : sequence of str, n
        Empty where a pair has none.
    weights : array_like, (n,)
        > 0; 1 by default.
    enabled : array_like of bool, (n,)
        A pair that is not enabled is kept and never used.
    check : array_like of bool, (n,)
        A check point measures and never fits.

    Raises
    ------
    PointsRefused
        Where lengths differ, or a value is not finite or too large.

    Examples
    --------
    >>> pairs = ControlPoints([[0, 0], [10, 5]], [[1, 2], [11, 7]], names=["eye", "hand"])
    >>> len(pairs), pairs.names[1], pairs.enabled.all()
    (2, 'hand', np.True_)
    """

    reference: Any  # these five are arrays once the value is made
    target: Any
    names: tuple[str, ...] = ()
    weights: Any = None
    enabled: Any = None
    check: Any = None

    def __post_init__(self) -> None:
        reference, target = (_pairs(v) for v in (self.reference, self.target))
        n = len(reference)
        columns = {
            "reference": reference,
            "target": target,
            "names": tuple(str(v) for v in self.names) if len(self.names) else ("",) * n,
            "weights": _column(self.weights, n, 1.0, float),
            "enabled": _column(self.enabled, n, True, bool),
            "check": _column(self.check, n, False, bool),
        }
        problems = _faults(columns, n)
        if problems:
            raise PointsRefused(*problems)
        for name, value in columns.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.reference)


def _pairs(values: object) -> np.ndarray:
    return np.array(values, np.float64).reshape(-1, 2)


def _column(values: Any, n: int, default: float | bool, kind: type) -> np.ndarray:
    return np.full(n, default, kind) if values is None else np.array(values, kind).reshape(-1)


def _faults(columns: dict[str, Any], n: int) -> list[Problem]:
    problems = []
    for name, value in columns.items():
        if len(value) != n:
            problems.append(
                Problem(
                    "E_SIZE",
                    "the numbers of points differ",
                    field=name,
                    found=len(value),
                    expected=n,
                )
            )
    if n > MOST_POINTS:
        problems.append(
            Problem("E_SIZE", "too many points", found=n, expected=f"at most {MOST_POINTS}")
        )
    for name in ("reference", "target"):
        points = np.asarray(columns[name])
        wrong = ~np.all(np.abs(points) <= LARGEST_COORDINATE, axis=1)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            problems.append(
                Problem(
                    "E_VALUE",
                    f"point {row + 1} is not a valid position",
                    field=name,
                    found=points[row].tolist(),
                    expected=f"finite numbers up to {LARGEST_COORDINATE:.0f}",
                )
            )
    weights = np.asarray(columns["weights"])
    if not (np.isfinite(weights).all() and (weights > 0).all()):
        problems.append(
            Problem("E_VALUE", "a weight must be > 0 and finite", field="weights", expected="> 0")
        )
    names = columns["names"]
    long = next((v for v in names if len(v) > LONGEST_NAME or not v.isprintable()), None)
    if long is not None:
        problems.append(
            Problem(
                "E_VALUE",
                "the name of a point is not valid",
                field="names",
                found=repr(long)[:80],
                expected=f"at most {LONGEST_NAME} printable characters",
            )
        )
    return problems


# --- text files, each refused where it stands


def check_lines(data: bytes) -> None:
    """Refuse more lines than a file of points can need; raises PointsRefused."""
    if (lines := data.count(b"\n")) > MOST_LINES:
        raise unreadable(f"{lines} lines", f"at most {MOST_LINES}")


def decode(data: bytes) -> str:
    """Return a text in UTF-8, with or without a mark of its byte order.

    Raises
    ------
    PointsRefused
        Where it is none, or has too many lines, or one that is too long.
    """
    check_lines(data)
    if (longest := max(map(len, data.split(b"\n")))) > LONGEST_TEXT_LINE:
        raise unreadable(f"a line of {longest} bytes", f"lines of at most {LONGEST_TEXT_LINE}")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise unreadable(str(error), "text in UTF-8") from error


def rows(text: str, delimiter: str = ",") -> list[list[str]]:
    """Split a table into its rows that hold anything.

    Raises
    ------
    PointsRefused
        Where a line is too long, or there are more rows than points may be.
    """
    table: list[list[str]] = []
    try:
        for row in csv.reader(io.StringIO(text, newline=""), delimiter=delimiter):
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


def write_rows(table: Iterable[Sequence[object]], delimiter: str = ",", quote: bool = False) -> str:
    """Return rows as a table; floats are written so that they are read back as they were."""
    stream = io.StringIO(newline="")
    writer = csv.writer(
        stream,
        delimiter=delimiter,
        quoting=csv.QUOTE_ALL if quote else csv.QUOTE_MINIMAL,
        lineterminator="\n",
    )
    writer.writerows([[number_text(v) for v in row] for row in table])
    return stream.getvalue()


def number_text(value: object) -> object:
    """Return a float as its shortest exact text, everything else as it is."""
    return repr(float(value)) if isinstance(value, float) else value


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
    return PointsRefused(
        Problem(
            "E_UNREADABLE", "control points cannot be read", found=found[:200], expected=expected
        )
    )
