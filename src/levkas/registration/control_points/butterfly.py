"""Control points of Butterfly Registrator (Van Gogh Museum): a table between bars.

Lines ``Butterfly Registrator``, its version, ``control points``, a remark, ``target``, a file name,
``moving``, file names, ``x|y|x|y``, then a row a point. Its *target* is our reference. Its moving
picture is first shrunk or grown to fit into the reference from the top left, keeping its shape, and
padded; the moving points are those of that picture. Pixel corners are integers (a Qt scene). To undo
the fitting, the sizes of both pictures must be known.
Source: `save_points` and `read_resize_pad_register` of
https://github.com/olive-groves/butterfly_registrator.
"""

from __future__ import annotations

import numpy as np

from levkas.core.problems import Problem
from levkas.registration.control_points.points import (
    ControlPoints,
    PointsRefused,
    Size,
    decode,
    from_origin,
    number,
    rows,
    to_origin,
    unreadable,
    write_rows,
)

REMARK = "Assumes moving image(s) resized and padded to match target image dimensions"


def recognises(data: bytes) -> bool:
    """Return whether the first line is the program's name."""
    return data[:64].removeprefix(b"\xef\xbb\xbf").lstrip(b'"').startswith(b"Butterfly Registrator")


def fitted_scale(reference: Size, target: Size) -> np.ndarray:
    """Scale of x and y by which the program fits the target into the reference.

    Examples
    --------
    >>> fitted_scale((1000, 800), (500, 200)).tolist()
    [2.0, 2.0]
    >>> fitted_scale((100, 100), (3, 7)).tolist()  # the other side is cut to whole pixels
    [14.0, 14.285714285714286]
    """
    (w, h), (tw, th) = reference, target
    aspect = tw / th
    width, height = (w, int(w / aspect)) if aspect > w / h else (int(h * aspect), h)
    return np.array([width / tw, height / th])


def read(data: bytes, sizes: tuple[Size | None, Size | None] = (None, None)) -> ControlPoints:
    """Read points; `sizes` are those of the reference and of the target.

    Raises
    ------
    PointsRefused
        Also where a size is not given.
    """
    table = rows(decode(data), "|")
    titles = [row[0].strip() if len(row) == 1 else "" for row in table]
    if "target" not in titles or len(table) < titles.index("target") + 5:
        raise unreadable("no line `target`", "a file of Butterfly Registrator")
    start = titles.index("target")
    places = []
    for line, row in enumerate(table[start + 5 :], start=start + 6):
        if len(row) < 4:
            raise unreadable(f"{len(row)} columns in line {line}", "x|y|x|y")
        places.append([number(cell, f"line {line}") for cell in row[:4]])
    place = np.array(places, float).reshape(-1, 4)
    scale = fitted_scale(*_both(sizes))
    return ControlPoints(
        from_origin(place[:, :2], "corner"),
        from_origin(place[:, 2:] / scale, "corner"),
        reference_frame=table[start + 1][0],
        target_frame=table[start + 3][0],
        reference_size=sizes[0],
        target_size=sizes[1],
    )


def _both(sizes: tuple[Size | None, Size | None]) -> tuple[Size, Size]:
    reference, target = sizes
    if reference is None or target is None:
        raise PointsRefused(
            Problem(
                "E_SIZE",
                "Butterfly Registrator needs the sizes of both pictures",
                field="reference_size, target_size",
                expected="the scale by which it fitted one into the other",
                fix="Give --reference-size and --target-size, width,height.",
            )
        )
    return reference, target


def write(points: ControlPoints) -> tuple[bytes, ...]:
    """Write points; the enabled pairs only. The program itself takes four.

    Raises
    ------
    PointsRefused
        Where a size is not known.
    """
    scale = fitted_scale(*_both((points.reference_size, points.target_size)))
    used = points.keep(points.enabled)
    head = [
        ["Butterfly Registrator"], ["1.1.0"], ["control points"], [REMARK],
        ["target"], [points.reference_frame or "reference"],
        ["moving"], [points.target_frame or "target"], ["x", "y", "x", "y"],
    ]  # fmt: skip
    reference, target = (
        to_origin(used.reference, "corner"),
        to_origin(used.target, "corner") * scale,
    )
    return (write_rows([*head, *np.hstack([reference, target]).tolist()], "|").encode(),)
