"""Control points from files and to files."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from levkas.core.problems import Problem
from levkas.core.text import LARGEST_TABLE, TextRefused, check_file
from levkas.registration.control_points.dialects import DIALECTS, format_points, parse_points, sniff
from levkas.registration.control_points.points import ControlPoints, PointsRefused, Size

_SIDES = (("reference", "target"), ("fixed", "moving"))


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
        A key of `DIALECTS`; else it is told from the content.
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
        Where a file of that name stands already, unless `overwrite`, or the disk refuses.
    """
    from levkas.core.files import write_bytes
    from levkas.core.ownership import require_free

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
    """The file of the target beside that of the reference, by its name."""
    for first, second in _SIDES:
        if re.search(first, path.name, re.IGNORECASE):
            other = path.with_name(re.sub(first, second, path.name, flags=re.IGNORECASE))
            return other if other.is_file() else None
    return None
