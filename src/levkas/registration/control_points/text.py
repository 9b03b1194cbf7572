"""Numbers and rows of the text files that hold control points, each refused where it stands."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from math import isfinite

from levkas.core.problems import Problem
from levkas.registration.control_points.points import MOST_POINTS, PointsRefused

LONGEST_LINE = 4096
LONGEST_TEXT_LINE = 4 * LONGEST_LINE
"""Of a text as it stands: a reference system in a comment may be long."""
MOST_LINES = 4 * MOST_POINTS
"""Empty ones and comments counted: the work of reading is bounded by it, whatever the lines hold."""


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
