"""Control points in a project of Hugin (`.pto`): its ``c`` lines.

``c n0 N1 x1066.5 y844.333 X239.52 Y804.64 t0``: n and N are pictures by their order of ``i`` lines,
x, y lie in n and X, Y in N, from the top left, in pixels whose centres are integers (libpano13 takes
(width − 1)/2 for the middle). t0 is a point; other types are lines and are left out. Image 0 is the
reference. ``i`` lines carry sizes (w, h) and file names (n"…"), which become the frames.
Sources: the documentation of Panotools::Script (Control, Image) and of Hugin, "PTO format".
"""

from __future__ import annotations

import re

from levkas.core.problems import Problem
from levkas.registration.control_points.points import (
    LONGEST_LINE,
    ControlPoints,
    PointsRefused,
    Size,
    decode,
    number,
    number_text,
    unreadable,
)

_WORD = re.compile(r'([a-zA-Z]+)("[^"]*"|[^\s"]+)')


def recognises(data: bytes) -> bool:
    """Return whether there are lines of pictures and of points."""
    if data.startswith(b"# hugin project file"):
        return True
    lines = data.split(b"\n")
    points = (line[:LONGEST_LINE].split() for line in lines if line.startswith((b"c ", b"c\t")))
    return any(_names(words, b"n") and _names(words, b"N") for words in points)


def _names(words: list[bytes], letter: bytes) -> bool:
    """Return whether a picture is among the words of a line: ``n0``."""
    return any(word.startswith(letter) and word[1:].isdigit() for word in words)


def read(data: bytes) -> ControlPoints:
    """Read the points between the two pictures of a project."""
    images: list[dict[str, str]] = []
    found: list[tuple[int, int, list[float]]] = []
    for line, text in enumerate(decode(data).splitlines(), start=1):
        kind, _, rest = text.partition(" ")
        if kind == "i":
            images.append(_words(rest))
        elif kind == "c" and (point := _point(_words(rest), f"line {line}")):
            found.append(point)
    pairs = {(n, m) for n, m, _ in found}
    if len(pairs) > 1:
        raise unreadable(
            f"points between {len(pairs)} pairs of pictures", "a project of two pictures"
        )
    first, second = next(iter(pairs), (0, 1))
    frames = [images[i] if i < len(images) else {} for i in (first, second)]
    return ControlPoints(
        [v[:2] for _, _, v in found],
        [v[2:] for _, _, v in found],
        reference_frame=frames[0].get("n", "").strip('"'),
        target_frame=frames[1].get("n", "").strip('"'),
        reference_size=_size(frames[0]),
        target_size=_size(frames[1]),
    )


def _words(text: str) -> dict[str, str]:
    return dict(_WORD.findall(text))


def _point(words: dict[str, str], where: str) -> tuple[int, int, list[float]] | None:
    """One pair, the picture of the lower number first; None for a line."""
    missing = [key for key in ("n", "N", "x", "y", "X", "Y") if key not in words]
    if missing:
        raise unreadable(f"no {missing[0]} in {where}", "c n N x y X Y")
    n, m = (int(number(words[key], where)) for key in ("n", "N"))
    values = [number(words[key], where) for key in ("x", "y", "X", "Y")]
    if n == m or int(number(words.get("t", "0"), where)) != 0:
        return None
    return (n, m, values) if n < m else (m, n, values[2:] + values[:2])


def _size(words: dict[str, str]) -> Size | None:
    if not {"w", "h"} <= words.keys():
        return None
    width, height = (int(number(words[key], "an i line")) for key in ("w", "h"))
    return (width, height) if width > 0 and height > 0 else None


def write(points: ControlPoints) -> tuple[bytes, ...]:
    """Write a project of two pictures; the enabled pairs only, as Hugin has no switch for a pair.

    Raises
    ------
    PointsRefused
        Where the size of a picture is not known: Hugin computes with it.
    """
    lines = ["# hugin project file", "#hugin_ptoversion 2", "p f0 w1000 h1000 v10", "m i0"]
    frames = (points.reference_frame or "reference", points.target_frame or "target")
    for frame, size in zip(frames, (points.reference_size, points.target_size), strict=True):
        if size is None:
            raise PointsRefused(
                Problem(
                    "E_SIZE",
                    "Hugin needs the sizes of both pictures",
                    field="reference_size, target_size",
                    fix="Give --reference-size and --target-size, width,height.",
                )
            )
        name = frame.replace('"', "'")
        lines.append(f'i w{size[0]} h{size[1]} f0 v10 r0 p0 y0 a0 b0 c0 d0 e0 n"{name}"')
    used = points.keep(points.enabled)
    for (x, y), (u, v) in zip(used.reference.tolist(), used.target.tolist(), strict=True):
        numbers = (f"{k}{number_text(c)}" for k, c in zip("xyXY", (x, y, u, v), strict=True))
        lines.append(f"c n0 N1 {' '.join(numbers)} t0")
    return ("\n".join([*lines, ""]).encode(),)
