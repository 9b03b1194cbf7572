"""Names, meanings, colours and usability of all pixel flags, in one table.

Whatever shows flags to people takes them from here: the viewer's maps and readout, README.md of a
publication. A flag that is not in the table is not to be trusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from levkas.core.cube import Flag


@dataclass(frozen=True)
class Mark:
    """How a flag is shown: a word for a cell of a table, its meaning, its colour (red, green, blue), 0 … 255.

    `trusted`: whether the value is an estimate of the paint's reflectance all the same.
    """

    word: str
    meaning: str
    colour: tuple[int, int, int]
    trusted: bool = False

    @property
    def css(self) -> str:
        """The colour as pages write it: ``#rrggbb``."""
        return "#{:02x}{:02x}{:02x}".format(*self.colour)


MARKS = {
    Flag.DEFECT: Mark("defect, replaced", "a defect, replaced from its neighbours; or the whole band, which its file calls bad", (38, 166, 154), True),
    Flag.NEAR: Mark("near a flag", "interpolated from a flagged pixel", (120, 144, 156)),
    Flag.BLACK: Mark("clipped at black", "clipped at black", (92, 107, 192)),
    Flag.VEILED: Mark("veiled", "veiled: brighter than under the default lighting by the same amount in every band; " "the paint is visible", (144, 202, 249)),
    Flag.MOVED: Mark("moved", "moved between shots", (171, 71, 188)),
    Flag.GLARE: Mark("glare", "glare: reflection of the lamp in varnish or gold", (255, 202, 40)),
    Flag.SATURATED: Mark("saturated", "saturated", (239, 83, 80)),
    Flag.OUTSIDE: Mark("outside", "outside the camera's frame, or the file holds nothing there; the value is NaN", (70, 72, 76)),
}  # fmt: skip
"""Least first: a map shows the gravest flag that any band of a pixel has."""


def describe_marks() -> list[dict[str, Any]]:
    """Return the table as a page needs it, by ascending bits.

    >>> describe_marks()[-1]
    {'bit': 128, 'word': 'veiled', 'colour': '#90caf9', 'trusted': False}
    """
    return [
        {"bit": int(flag), "word": mark.word, "colour": mark.css, "trusted": mark.trusted}
        for flag, mark in sorted(MARKS.items())
    ]
