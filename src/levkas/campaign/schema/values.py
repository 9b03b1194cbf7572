"""Kinds of values in campaign.toml, each with one sentence for what it must be."""

from __future__ import annotations

import datetime
import re
import unicodedata
from math import isqrt
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, PlainValidator, Strict

from levkas.core.text import CONTROL

FILTER_LETTERS = "RGBCMYWEIN"
"""Of a pattern in letters: primary and complementary colours, white, emerald, infrared."""
MOST_CORNERS = 500
"""Of an outline: sides are compared two by two, in a tenth of a second. Half of it still follows any panel."""

Point = tuple[float, float]


def _without_controls(value: Any) -> Any:
    """Null and its like end names of files, and are in no XML, JSON page or terminal what they seem."""
    if isinstance(value, str) and (found := CONTROL.search(value)):
        raise ValueError(f"must be text without control characters, not {found[0]!r}")
    return value


def _names(value: Any) -> tuple[str, ...]:
    names = (value,) if isinstance(value, str) else value
    if not isinstance(names, list | tuple) or not all(isinstance(n, str) and n for n in names):
        raise ValueError("must be a name or a list of names")
    return tuple(unicodedata.normalize("NFC", _without_controls(n)) for n in names)


def _path(value: Any) -> Any:
    """Refuse a home folder in the shell's way: what is written is a path, or below the campaign."""
    if isinstance(value, str) and re.match(r"~$|~[\w.-]*[/\\]", value):
        raise ValueError(
            "must be a path, whole or from the campaign: ~ means a home to shells alone"
        )
    return _without_controls(value)


def _files(value: Any) -> tuple[str, ...]:
    return tuple(_path(name) for name in _names(value))


def _date(value: Any) -> str:
    text = value.isoformat() if isinstance(value, datetime.date | datetime.datetime) else value
    if not isinstance(text, str) or not is_date(text):
        raise ValueError("must be a date as ISO 8601: 2024, 2024-05, 2024-05-31")
    return text


def is_date(text: str) -> bool:
    """Whether a text is a day of the calendar as ISO 8601, a month or a year, or a day with its time.

    >>> is_date("2024"), is_date("2024-02-30"), is_date("2024-02-29T10:30:00+01:00")
    (True, False, True)
    """
    found = re.fullmatch(r"(\d{4})(?:-(\d\d)(?:-(\d\d)([T ].+)?)?)?", text, re.ASCII)
    if not found:
        return False
    try:
        datetime.date(*(int(part or 1) for part in found.groups()[:3]))
        if found[4]:
            datetime.datetime.fromisoformat(text)
    except ValueError:
        return False
    return True


def _museum_date(value: Any) -> str:
    """Paintings are dated "about 1650" as often as 1650."""
    if isinstance(value, bool) or not isinstance(value, str | int | datetime.date):
        raise ValueError("must be a year or text")
    if isinstance(value, str) and re.fullmatch(r"\d{4}-\d\d-\d\d", value) and not is_date(value):
        raise ValueError("must be a day of the calendar, or text")
    return value.isoformat() if isinstance(value, datetime.date) else _without_controls(str(value))


def _pattern(value: Any) -> tuple[tuple[str, ...], ...]:
    """Bring ``"RGGB"``, or rows of names, into rows of names."""
    message = 'must be letters such as "RGGB", or rows of equally many channel names'
    if isinstance(value, str):
        side = isqrt(len(value))
        letters = value.upper()
        if side < 2 or side * side != len(value) or set(letters) - set(FILTER_LETTERS):
            raise ValueError(message)
        return tuple(tuple(letters[i : i + side]) for i in range(0, side * side, side))
    if not isinstance(value, list | tuple) or not all(isinstance(r, list | tuple) for r in value):
        raise ValueError(message)
    rows = tuple(tuple(row) for row in value)
    if not all(isinstance(n, str) and n and not CONTROL.search(n) for row in rows for n in row):
        raise ValueError(message)
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        raise ValueError(message)
    return rows


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e12


def _reflectance(value: Any) -> float | str:
    if isinstance(value, str) and value:
        return str(_path(value))
    if not _is_number(value) or not 0 < value <= 1.5:
        raise ValueError("must be a reflectance such as 0.98, or a CSV over wavelength")
    return float(value)


def _region(value: Any) -> Any:
    if value == "auto":
        return value
    fits = isinstance(value, list | tuple) and len(value) == 4 and all(map(_is_number, value))
    if not fits or value[2] <= 0 or value[3] <= 0:
        raise ValueError('must be [x, y, width, height] with width and height > 0, or "auto"')
    return tuple(float(v) for v in value)


def _outline(value: Any) -> Any:
    """Check a closed polygon; whether it lies in the picture is known where that is read."""
    corners = value if isinstance(value, list | tuple) else ()
    if not corners or not all(
        isinstance(c, list | tuple) and len(c) == 2 and all(map(_is_number, c)) for c in corners
    ):
        raise ValueError("must be a list of corners [[x, y], …], px of the reference")
    corners = tuple((float(x), float(y)) for x, y in corners)
    if len(corners) > 1 and corners[0] == corners[-1]:
        corners = corners[:-1]  # closed by hand, as other programs write it
    if not 3 <= len(corners) <= MOST_CORNERS:
        raise ValueError(f"must have 3 to {MOST_CORNERS} corners, not {len(corners)}")
    if crossing := _crossing_sides(corners):
        first, second = crossing
        raise ValueError(
            f"must not cross or touch itself: the side after corner {first + 1} meets the one after corner {second + 1}"
        )
    return corners


def _crossing_sides(corners: tuple[tuple[float, float], ...]) -> tuple[int, int] | None:
    """Return the first two sides of a closed polygon, by their first corners, that have a point in common; None where only neighbours do.

    >>> _crossing_sides(((0, 0), (9, 9), (9, 0), (0, 9))), _crossing_sides(((0, 0), (9, 0), (9, 9)))
    ((0, 2), None)
    """
    count = len(corners)
    sides = [(corners[k], corners[(k + 1) % count]) for k in range(count)]
    for first, (a, b) in enumerate(sides):
        for second in range(first + 1, count):
            c, d = sides[second]
            if second == first + 1 or (first == 0 and second == count - 1):
                # Neighbours have a corner in common, and no more unless one runs back along the other.
                start, shared, end = (a, b, d) if second == first + 1 else (c, a, b)
                back = (shared[0] - start[0]) * (end[0] - shared[0])
                back += (shared[1] - start[1]) * (end[1] - shared[1])
                if _turn(start, shared, end) == 0 and back <= 0:
                    return first, second
            elif _meet(a, b, c, d):
                return first, second
    return None


def _meet(a: Point, b: Point, c: Point, d: Point) -> bool:
    """Return whether the lines from a to b and from c to d have a point in common."""
    if max(a[0], b[0]) < min(c[0], d[0]) or max(c[0], d[0]) < min(a[0], b[0]):
        return False
    if max(a[1], b[1]) < min(c[1], d[1]) or max(c[1], d[1]) < min(a[1], b[1]):
        return False
    return _turn(a, b, c) * _turn(a, b, d) <= 0 and _turn(c, d, a) * _turn(c, d, b) <= 0


def _turn(a: Point, b: Point, c: Point) -> float:
    """Return twice the area of a triangle, its sign by the sense in which it is run round."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _pair(value: Any) -> Any:
    fits = isinstance(value, list | tuple) and len(value) == 2 and all(map(_is_number, value))
    if not fits or min(value) <= 0:
        raise ValueError("must be [width, height], two numbers > 0")
    return tuple(float(v) for v in value)


def _size(value: Any) -> Any:
    width, height = _pair(value)
    if width % 1 or height % 1:
        raise ValueError("must be [width, height] in whole pixels")
    return int(width), int(height)


def _align(value: Any) -> Any:
    if value == "measure":
        return value
    rows = value if isinstance(value, list | tuple) and len(value) == 2 else ()
    if not rows or not all(
        isinstance(r, list | tuple) and len(r) == 3 and all(map(_is_number, r)) for r in rows
    ):
        raise ValueError('must be "measure", or a 2x3 matrix [[a, b, c], [d, e, f]]')
    (a, b, _), (d, e, _) = rows
    if abs(a * e - b * d) < 1e-6:
        raise ValueError("must be a matrix that has an inverse")
    return tuple(tuple(float(v) for v in row) for row in rows)


def _doi(value: Any) -> str:
    text = value.strip() if isinstance(value, str) else ""
    text = re.sub(r"^(https?://(dx\.)?doi\.org/|doi:)", "", text, flags=re.I)
    if not re.match(r"10\.\d{4,9}/\S+$", text):
        raise ValueError('must be a DOI such as "10.5281/zenodo.1234567"')
    return text


def _orcid(value: Any) -> str:
    """Sixteen digits, the last of them ISO 7064's check, which may be X."""
    text = value.strip() if isinstance(value, str) else ""
    text = re.sub(r"^https?://orcid\.org/", "", text).upper()
    total = 0
    for digit in text.replace("-", "")[:15]:
        total = (total + (int(digit) if digit.isdecimal() else 0)) * 2
    check = "0123456789X"[(12 - total % 11) % 11]
    if not re.match(r"\d{4}-\d{4}-\d{4}-\d{3}[\dX]$", text) or text[-1] != check:
        raise ValueError('must be an ORCID with its check digit, such as "0000-0002-1825-0097"')
    return text


def is_address(text: str) -> bool:
    """Whether a text is an address of the web.

    >>> is_address("https://example.org/icons"), is_address("example.org")
    (True, False)
    """
    return re.fullmatch(r"https?://[^\s<>\"]+", text) is not None


def _address(value: Any) -> str:
    if not isinstance(value, str) or not is_address(value):
        raise ValueError('must be an address that begins with "https://"')
    return value


Text = Annotated[str, Strict(), BeforeValidator(_without_controls)]
PathText = Annotated[str, Strict(), BeforeValidator(_path)]
Doi = Annotated[str, BeforeValidator(_doi)]
Orcid = Annotated[str, BeforeValidator(_orcid)]
Address = Annotated[str, BeforeValidator(_address)]
Number = Annotated[float, Strict()]
Whole = Annotated[int, Strict()]
Switch = Annotated[bool, Strict()]


Names = Annotated[tuple[str, ...], BeforeValidator(_names)]
Files = Annotated[tuple[str, ...], BeforeValidator(_files)]
MosaicPattern = Annotated[tuple[tuple[str, ...], ...], PlainValidator(_pattern)]
Align = Annotated[
    Literal["measure"] | tuple[tuple[float, float, float], ...], PlainValidator(_align)
]


def _rectangles(value: Any) -> tuple[tuple[int, int, int, int], ...]:
    several = value if isinstance(value, list) and value and isinstance(value[0], list) else [value]
    for one in several:
        fits = isinstance(one, list) and len(one) == 4 and all(type(v) is int for v in one)
        if not fits or min(one[:2]) < 0 or min(one[2:]) < 1:
            raise ValueError(
                "must be [x, y, width, height] in whole native pixels, or a list of such"
            )
    return tuple((int(x), int(y), int(w), int(h)) for x, y, w, h in several)


Rectangles = Annotated[tuple[tuple[int, int, int, int], ...], PlainValidator(_rectangles)]
Outline = Annotated[tuple[tuple[float, float], ...], PlainValidator(_outline)]
Region = Annotated[Literal["auto"] | tuple[float, float, float, float], PlainValidator(_region)]
Date = Annotated[str, BeforeValidator(_date)]
MuseumDate = Annotated[str, BeforeValidator(_museum_date)]
Reflectance = Annotated[float | str, PlainValidator(_reflectance)]
Size = Annotated[tuple[int, int], PlainValidator(_size)]
SizeMm = Annotated[tuple[float, float], PlainValidator(_pair)]
