"""Point files of elastix and transformix: one file a picture.

First line ``point`` or ``index``, second the number of points, then x y (z) a line. `index` counts
pixels; `point` is physical and the same thing for a picture of spacing 1 and origin 0: both have
pixel centres at integers, the x axis first. ``elastix -fp FIXED -mp MOVING`` takes the two files;
fixed is the reference. The table that transformix writes (``outputpoints.txt``: ``InputPoint = [ … ]
; OutputPoint = [ … ]``) holds both in one file.
Sources: the elastix manual, "Transforming points", and https://github.com/hsokooti/regnet/issues/13.
"""

from __future__ import annotations

import re

from levkas.registration.control_points.points import (
    MOST_POINTS,
    ControlPoints,
    decode,
    number,
    number_text,
    unreadable,
)

MOST_WORDS = 2 + 3 * MOST_POINTS
_OUTPUT = re.compile(r"(InputPoint|OutputPoint)\s*=\s*\[([^][]*)\]")


def recognises(data: bytes) -> bool:
    """Return whether it starts with `point` or `index` and a count, or is transformix's table."""
    start = data[:4096].lstrip(b"\xef\xbb\xbf")
    return bool(re.match(rb"\s*(point|index)\s+\d+\s", start, re.IGNORECASE)) or (
        b"InputPoint" in start and b"OutputPoint" in start
    )


def read(data: bytes, target: bytes | None = None) -> ControlPoints:
    """Read the fixed points and the moving ones, or transformix's table of both."""
    text = decode(data)
    if target is None:
        if "OutputPoint" not in text:
            raise unreadable(
                "one point file", "two, of the fixed and of the moving picture, or outputpoints.txt"
            )
        return _read_output(text)
    return ControlPoints(_read_points(text), _read_points(decode(target)))


def _read_points(text: str) -> list[list[float]]:
    words = text.split(maxsplit=MOST_WORDS)
    if len(words) > MOST_WORDS:
        raise unreadable("more words", f"at most {MOST_POINTS} points of two or three numbers")
    if len(words) < 2 or words[0].lower() not in ("point", "index"):
        raise unreadable(" ".join(words[:2])[:60], "`point` or `index`, then how many")
    count = int(number(words[1], "line 2"))
    values = [number(word, "the list of points") for word in words[2:]]
    ndim = next((d for d in (2, 3) if count * d == len(values)), None)
    if ndim is None:
        raise unreadable(f"{len(values)} numbers", f"{count} points of two or three")
    return [values[i : i + 2] for i in range(0, len(values), ndim)]


def _read_output(text: str) -> ControlPoints:
    sides: dict[str, list[list[float]]] = {"InputPoint": [], "OutputPoint": []}
    for kind, inside in _OUTPUT.findall(text):
        values = [number(word, kind) for word in inside.split()]
        if len(values) not in (2, 3):
            raise unreadable(f"{kind} of {len(values)} numbers", "two or three")
        sides[kind].append(values[:2])
    return ControlPoints(sides["InputPoint"], sides["OutputPoint"])


def write(points: ControlPoints) -> tuple[bytes, ...]:
    """Write two files, fixed then moving; the enabled pairs only."""
    used = points.keep(points.enabled)
    return tuple(
        "\n".join(
            ["point", str(len(side)), *(f"{number_text(x)} {number_text(y)}" for x, y in side), ""]
        ).encode()
        for side in (used.reference.tolist(), used.target.tolist())
    )
