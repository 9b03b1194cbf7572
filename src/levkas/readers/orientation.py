"""EXIF orientation: how viewers turn and mirror a file whose pixels are stored otherwise."""

from __future__ import annotations

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
    return {**({"mirror": True} if mirror else {}), **({"rotate": rotate} if rotate else {})}
