"""EXIF orientation: how viewers turn and mirror a file whose pixels are stored otherwise."""

from __future__ import annotations

from typing import Any

UPRIGHT: dict[int, tuple[bool, int]] = {
    2: (True, 0),
    3: (False, 180),
    4: (True, 180),
    5: (True, 270),
    6: (False, 90),
    7: (True, 90),
    8: (False, 270),
}
"""EXIF orientation (tag 274) → `mirror` and `rotate` of the grid that shows such a file upright: Exif 2.32, section 4.6.4."""


def read_orientation(value: Any) -> int | None:
    """Return the tag Orientation, a number or a list of one, where it turns or mirrors a picture: 2 to 8.

    >>> read_orientation([6]), read_orientation(1), read_orientation("top")
    (6, None, None)
    """
    first = value[0] if isinstance(value, list | tuple) and value else value
    return int(first) if isinstance(first, int) and 2 <= first <= 8 else None


def describe_turn(orientation: int) -> str:
    """Return in words how a viewer shows a file with an EXIF orientation of 2 to 8.

    >>> describe_turn(6), describe_turn(5), describe_turn(2)
    ('turned by 90° clockwise', 'mirrored, then turned by 270° clockwise', 'mirrored')
    """
    mirror, rotate = UPRIGHT[orientation]
    turned = f"turned by {rotate}° clockwise" if rotate else ""
    return ", then ".join(filter(None, ("mirrored" if mirror else "", turned)))


def grid_keys(orientation: int) -> dict[str, bool | int]:
    """Return the keys of [grid] that show a file with an EXIF orientation of 2 to 8 upright.

    >>> grid_keys(6), grid_keys(7)
    ({'rotate': 90}, {'mirror': True, 'rotate': 90})
    """
    mirror, rotate = UPRIGHT[orientation]
    keys: dict[str, bool | int] = {"mirror": mirror, "rotate": rotate}
    return {key: value for key, value in keys.items() if value}
