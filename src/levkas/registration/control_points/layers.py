"""Control points by object, camera and band: one table for a whole campaign, or a file for one frame."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from levkas.core.problems import Problem
from levkas.core.text import TextRefused, read_text
from levkas.registration.control_points import table
from levkas.registration.control_points.dialects import read_points, sniff
from levkas.registration.control_points.points import (
    ControlPoints,
    PointsRefused,
    decode,
    rows,
    write_rows,
)

#: (object, CAMERA or CAMERA@SETUP, band; empty for the camera's reference channel)
Frame = tuple[str, str, str]
FRAME = ("object", "camera", "band")
MOST_FRAMES = 5000
"""Of one table: each is read by itself."""


def is_table_of_frames(path: Path) -> bool:
    """Return whether a file is a CSV with the columns object and camera, and the four coordinates."""
    with path.open("rb") as file:
        first = file.readline(4096).removeprefix(b"\xef\xbb\xbf").decode("utf-8", "replace")
    cells = {cell.strip().strip('"') for cell in first.split(",")}
    return set(table.PLACES) | {"object", "camera"} <= cells


def read_table_of_frames(path: Path) -> dict[Frame, ControlPoints]:
    """Read a CSV of several frames: object, camera, band (may be left out), and the columns of `table`.

    Raises
    ------
    PointsRefused
    """
    try:
        text = read_text(path, "a CSV in UTF-8")
    except TextRefused as refused:
        raise PointsRefused(*refused.problems) from None
    try:
        body = rows(decode(text.encode()))
    except PointsRefused as refused:
        raise PointsRefused(*(replace(p, file=str(path)) for p in refused.problems)) from None
    head = [cell.strip() for cell in body[0]]
    places = [head.index(name) if name in head else None for name in FRAME]
    groups: dict[Frame, list[list[str]]] = {}
    for row in body[1:]:
        frame = tuple("" if p is None or p >= len(row) else row[p].strip() for p in places)
        groups.setdefault(frame, []).append(row)  # type: ignore[arg-type]
        if len(groups) > MOST_FRAMES:
            raise PointsRefused(
                Problem(
                    "E_SIZE",
                    "the table has points of too many frames",
                    str(path),
                    "object, camera, band",
                    f"more than {MOST_FRAMES}",
                    f"at most {MOST_FRAMES}",
                    "Write a table for each camera.",
                )
            )
    try:
        return {
            frame: table.read(write_rows([head, *group]).encode())
            for frame, group in groups.items()
        }
    except PointsRefused as refused:
        raise PointsRefused(
            *(
                Problem(p.code, p.message, str(path), p.field, p.found, p.expected)
                for p in refused.problems
            )
        ) from None


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
        raise PointsRefused(
            Problem(
                "E_VALUE",
                "this is not a frame of an object",
                field="frame",
                found=text,
                expected="OBJECT/CAMERA, OBJECT/CAMERA@SETUP:BAND",
            )
        )
    return name, layer, band


def read_frames(
    path: Path, frame: str | None, layers: Collection[tuple[str, str]]
) -> dict[Frame, ControlPoints]:
    """Read check points of any kind.

    Parameters
    ----------
    path : Path
        A CSV of several frames, or a file of any dialect for one.
    frame : str, optional
        Which one, for the latter; not needed where there is only one.
    layers : collection of (object, layer)
        That there are.

    Raises
    ------
    PointsRefused
    """
    if path.is_file() and is_table_of_frames(path):
        if frame is not None:
            why, expected = (
                "the table names its frames itself",
                "a file of one frame, or no --frame",
            )
            raise PointsRefused(Problem("E_VALUE", why, str(path), "--frame", frame, expected))
        return read_table_of_frames(path)
    if frame is None and len(layers) != 1:
        dialect = sniff(path.read_bytes()[: 1 << 20]) if path.is_file() else ""
        raise PointsRefused(
            Problem(
                "E_VALUE",
                "the object and camera of these points are unknown",
                file=str(path),
                found=f"a file of {dialect}" if dialect else "no such file",
                expected=", ".join("/".join(key) for key in layers),
                fix="Add --frame OBJECT/CAMERA, or write a CSV with the columns object and camera.",
            )
        )
    name, layer, band = parse_frame(frame) if frame else (*next(iter(layers)), "")
    if (name, layer) not in layers:
        raise PointsRefused(
            Problem(
                "E_VALUE",
                f"unknown layer {name}/{layer}",
                field="frame",
                found=frame,
                expected=", ".join("/".join(key) for key in layers),
            )
        )
    return {(name, layer, band): read_points(path)}


def used_pairs(points: ControlPoints) -> np.ndarray:
    """Return the enabled pairs, (n, 4): reference x, y, target x, y."""
    return np.hstack([points.reference, points.target])[points.enabled]
