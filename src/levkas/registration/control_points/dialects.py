"""Dialects of control points: the programs that write them, what each can hold, and files read and written."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from levkas.core.files import write_bytes
from levkas.core.ownership import require_free
from levkas.core.problems import Problem, unknown_name
from levkas.core.text import LARGEST_TABLE, TextRefused, check_file
from levkas.registration.control_points import (
    bigwarp,
    butterfly,
    cpselect,
    elastix,
    hugin,
    napari,
    qgis,
    table,
)
from levkas.registration.control_points.points import (
    ControlPoints,
    PointsRefused,
    Size,
    check_lines,
)


@dataclass(frozen=True)
class Dialect:
    """File format in which one program writes control points.

    Parameters
    ----------
    title : str
        The program, for people.
    suffixes : tuple of str
        End of the name of each file that is written: one, or one a picture, reference first.
    origin : str
        A key of `points.ORIGINS`.
    keeps : frozenset of str
        What it holds beyond the places: names, weights, enabled, check, frames, sizes.
    module : module
        With `recognises(data)`, `read(data, …)` and `write(points)`.
    needs_sizes : bool
        Whether reading needs the sizes of both pictures.
    """

    title: str
    suffixes: tuple[str, ...]
    origin: str
    keeps: frozenset[str]
    module: Any
    needs_sizes: bool = False

    @property
    def recognises(self) -> Callable[[bytes], bool]:
        """Return whether a file is of this dialect, by its content."""
        return self.module.recognises


def _holds(*what: str) -> frozenset[str]:
    return frozenset(what)


ALL = _holds("names", "weights", "enabled", "check")
PAIR = (".reference", ".target")
#: Words of a file of the reference, and of that of the target beside it.
SIDES = (("reference", "target"), ("fixed", "moving"))
DIALECTS: dict[str, Dialect] = {
    "levkas": Dialect("Levkas", (".csv",), "centre", ALL, table),
    "bigwarp": Dialect("BigWarp", (".csv",), "centre", _holds("names", "enabled"), bigwarp),
    "qgis": Dialect("QGIS georeferencer", (".points",), "corner, y up", _holds("enabled"), qgis),
    "hugin": Dialect("Hugin", (".pto",), "centre", _holds("frames", "sizes"), hugin),
    "elastix": Dialect(
        "ITK, elastix", tuple(p + ".txt" for p in PAIR), "centre", _holds(), elastix
    ),
    "napari": Dialect("napari", tuple(p + ".csv" for p in PAIR), "centre", ALL, napari),
    "butterfly": Dialect(
        "Butterfly Registrator", (".csv",), "corner", _holds("frames"), butterfly, needs_sizes=True
    ),
    "cpselect": Dialect("MATLAB cpselect", (".csv",), "one", ALL, cpselect),
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
            fix="Export the points again, or write a CSV: reference_x,reference_y,x,y.",
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


def parse_points(
    files: list[bytes],
    *,
    dialect: str | None = None,
    reference_size: Size | None = None,
    target_size: Size | None = None,
) -> ControlPoints:
    """Read control points from the content of one file, or of two, reference first.

    Parameters
    ----------
    files : list of bytes
    dialect : str, optional
        A key of `DIALECTS`; else it is found from the content.
    reference_size, target_size : (width, height), px, optional
        Of both pictures, where the dialect needs them and its files lack them.

    Raises
    ------
    PointsRefused
    """
    for data in files:
        if len(data) > LARGEST_TABLE:
            raise PointsRefused(
                Problem(
                    "E_SIZE",
                    "the file of control points is too large",
                    found=f"{len(data) >> 20} MiB",
                    expected=f"at most {LARGEST_TABLE >> 20} MiB",
                )
            )
    name = dialect or sniff(files[0])
    row = _known(name)
    if len(files) > len(row.suffixes):
        raise PointsRefused(
            Problem("E_VALUE", f"{row.title} writes one file for both pictures", found=len(files))
        )
    sizes = (reference_size, target_size)
    points = row.module.read(*files, **({"sizes": sizes} if row.needs_sizes else {}))
    return points.sized(*sizes)


def format_points(points: ControlPoints, dialect: str) -> tuple[bytes, ...]:
    """Return the content of one file, or of two, reference first.

    Raises
    ------
    PointsRefused
        Where the dialect needs sizes that `points` does not have.
    """
    return _known(dialect).module.write(points)


def losses(points: ControlPoints, dialect: str) -> list[str]:
    """Return sentences about what a dialect cannot hold of these points.

    Examples
    --------
    >>> losses(ControlPoints([[0, 0]], [[1, 1]], enabled=[False]), "hugin")
    ['1 pair that is not enabled is left out']
    """
    keeps, sentences = _known(dialect).keeps, []
    off = int((~points.enabled).sum())
    if "enabled" not in keeps and off:
        sentences.append(
            f"{off} pair{'s' * (off > 1)} that {'are' if off > 1 else 'is'} not enabled {'are' if off > 1 else 'is'} left out"
        )
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


def read_points(
    path: str | Path,
    second: str | Path | None = None,
    *,
    dialect: str | None = None,
    reference_size: Size | None = None,
    target_size: Size | None = None,
) -> ControlPoints:
    """Read control points of any dialect.

    Parameters
    ----------
    path : path
        The file, or that of the reference where the dialect writes one a picture.
    second : path, optional
        The file of the target; found beside the first where the names differ by reference and
        target, or by fixed and moving.
    dialect : str, optional
        A key of `DIALECTS`; else it is found from the content.
    reference_size, target_size : (width, height), px, optional

    Raises
    ------
    PointsRefused
        With the file.
    """
    paths = [Path(path)]
    try:
        files = [_bytes(paths[0])]
        name = dialect or sniff(files[0])
        both = len(DIALECTS[name].suffixes) == 2 if name in DIALECTS else False
        other = Path(second) if second else (_partner(paths[0]) if both else None)
        if other is not None:
            paths.append(other)
            files.append(_bytes(other))
        return parse_points(
            files, dialect=name, reference_size=reference_size, target_size=target_size
        )
    except PointsRefused as refused:
        raise PointsRefused(
            *(p if p.file else replace(p, file=str(paths[-1])) for p in refused.problems)
        ) from None


def write_points(
    points: ControlPoints, path: str | Path, dialect: str, *, overwrite: bool = False
) -> list[Path]:
    """Write control points; a dialect of two files adds `.reference` and `.target` to the name.

    Returns
    -------
    paths : list of Path
        What was written.

    Raises
    ------
    PointsRefused
    WriteRefused
        Where a file of that name exists, unless `overwrite`, or the disk refuses.
    """
    contents = format_points(points, dialect)
    path = Path(path)
    suffixes = DIALECTS[dialect].suffixes
    paths = [path] if len(contents) == 1 else [path.with_name(path.stem + s) for s in suffixes]
    for one in paths:
        require_free(one, overwrite=overwrite)
    for one, data in zip(paths, contents, strict=True):
        write_bytes(one, data)
    return paths


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


def _partner(path: Path) -> Path | None:
    """Return the file of the target beside that of the reference, by its name."""
    for first, second in SIDES:
        if re.search(first, path.name, re.IGNORECASE):
            other = path.with_name(re.sub(first, second, path.name, flags=re.IGNORECASE))
            return other if other.is_file() else None
    return None
