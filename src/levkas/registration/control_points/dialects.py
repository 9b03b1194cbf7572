"""Dialects of control points: the programs that write them, what each can hold, and files read and written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from levkas.core.files import write_bytes
from levkas.core.ownership import require_free
from levkas.core.problems import Problem, unknown_name
from levkas.core.text import LARGEST_TABLE, TextRefused, check_file
from levkas.registration.control_points import bigwarp, qgis, table
from levkas.registration.control_points.points import ControlPoints, PointsRefused, check_lines


@dataclass(frozen=True)
class Dialect:
    """File format in which one program writes control points.

    Parameters
    ----------
    title : str
        The program, for people.
    suffix : str
        End of the name of a file that is written.
    keeps : frozenset of str
        What it holds beyond the places: names, weights, enabled, check.
    module : module
        With `recognises(data)`, `read(data)` and `write(points)`.
    """

    title: str
    suffix: str
    keeps: frozenset[str]
    module: Any

    @property
    def recognises(self) -> Callable[[bytes], bool]:
        """Return whether a file is of this dialect, by its content."""
        return self.module.recognises


ALL = frozenset(("names", "weights", "enabled", "check"))
DIALECTS: dict[str, Dialect] = {
    "levkas": Dialect("Levkas", ".csv", ALL, table),
    "bigwarp": Dialect("BigWarp", ".csv", frozenset(("names", "enabled")), bigwarp),
    "qgis": Dialect("QGIS georeferencer", ".points", frozenset(("enabled",)), qgis),
}


def sniff(data: bytes) -> str:
    """Return the dialect of a file from its content.

    Raises
    ------
    PointsRefused
        Where it is of none, or has more lines than points could need.

    Examples
    --------
    >>> sniff(b'"Pt-0","true","1","2","3","4"\\n')
    'bigwarp'
    """
    check_lines(data)
    for name, dialect in DIALECTS.items():
        try:
            if dialect.recognises(data):
                return name
        except PointsRefused:
            continue
    if qgis_without_header(data):
        return "qgis"
    raise PointsRefused(
        Problem(
            "E_UNREADABLE",
            "the format of these control points is unknown",
            found=repr(data[:40].decode("utf-8", "replace").splitlines()[:1])[1:-1] or "nothing",
            expected=", ".join(d.title for d in DIALECTS.values()),
            fix="Write a CSV with the columns reference_x,reference_y,x,y; the centre of the first pixel is 0, 0.",
        )
    )


def qgis_without_header(data: bytes) -> bool:
    """Return whether rows are the five to eight numbers of an old `.points` file, y upwards.

    >>> qgis_without_header(b"10.5 -3 99.25 -18 1\\n")
    True
    """
    words = data[:4096].split(b"\n")[0].replace(b",", b" ").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        return False
    return 5 <= len(values) <= 8 and values[3] <= 0


def parse_points(data: bytes, *, dialect: str | None = None) -> ControlPoints:
    """Read control points from the content of a file.

    Parameters
    ----------
    data : bytes
    dialect : str, optional
        A key of `DIALECTS`; else it is found from the content.

    Raises
    ------
    PointsRefused
    """
    if len(data) > LARGEST_TABLE:
        raise PointsRefused(
            Problem(
                "E_SIZE",
                "the file of control points is too large",
                found=f"{len(data) >> 20} MiB",
                expected=f"at most {LARGEST_TABLE >> 20} MiB",
            )
        )
    return _known(dialect or sniff(data)).module.read(data)


def format_points(points: ControlPoints, dialect: str) -> bytes:
    """Return the content of a file."""
    return _known(dialect).module.write(points)


def losses(points: ControlPoints, dialect: str) -> list[str]:
    """Return sentences about what a dialect cannot hold of these points.

    Examples
    --------
    >>> losses(ControlPoints([[0, 0]], [[1, 1]], names=["eye"]), "qgis")
    ['1 names not kept']
    """
    keeps, sentences = _known(dialect).keeps, []
    for what, number in (
        ("names", sum(map(bool, points.names))),
        ("weights", int((points.weights != 1).sum())),
        ("check", int(points.check.sum())),
    ):
        if what not in keeps and number:
            sentences.append(
                f"{number} {'marks as check point' if what == 'check' else what} not kept"
            )
    return sentences


def _known(dialect: str) -> Dialect:
    if dialect not in DIALECTS:
        what = f"unknown dialect {dialect!r}"
        raise PointsRefused(unknown_name(what, dialect, DIALECTS, field="dialect"))
    return DIALECTS[dialect]


def read_points(path: str | Path, *, dialect: str | None = None) -> ControlPoints:
    """Read control points of any dialect: a key of `DIALECTS`, else found from the content.

    Raises
    ------
    PointsRefused
        With the file.
    """
    path = Path(path)
    try:
        return parse_points(_bytes(path), dialect=dialect)
    except PointsRefused as refused:
        raise PointsRefused(
            *(p if p.file else replace(p, file=str(path)) for p in refused.problems)
        ) from None


def write_points(
    points: ControlPoints, path: str | Path, dialect: str, *, overwrite: bool = False
) -> None:
    """Write control points.

    Raises
    ------
    PointsRefused
    WriteRefused
        Where a file of that name exists, unless `overwrite`, or the disk refuses.
    """
    data = format_points(points, dialect)
    require_free(Path(path), overwrite=overwrite)
    write_bytes(Path(path), data)


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
