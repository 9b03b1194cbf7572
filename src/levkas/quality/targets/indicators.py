"""Quality indicators with the levels of FADGI (third edition, 2023) and ISO 19264-1:2021 that a value alone would reach.

Neither document was at hand. A limit is listed here where two independent publications give the same number, or the one
comparison of both standards that the table names; where they differ or nothing was found the level is left
blank, "–". They are indicators, never a certification: those standards judge whole systems on targets of their own.
"""

from __future__ import annotations

from math import inf
from typing import Any, NamedTuple

import numpy as np

Range = tuple[float, float]


class IndicatorLevels(NamedTuple):
    """An aim, and what is tolerated: FADGI from 4 stars down (as far as known), ISO levels A, B, C."""

    aim: str
    fadgi: tuple[Range, ...] = ()
    iso: tuple[Range, ...] = ()


def _up_to(*most: float) -> tuple[Range, ...]:
    return tuple((-inf, value) for value in most)


def _from(*least: float) -> tuple[Range, ...]:
    return tuple((value, inf) for value in least)


LIMITS = {
    "colour": IndicatorLevels("0", _up_to(2, 3.5, 5, 6.5), _up_to(4, 5, 5)),
    "colour 90": IndicatorLevels("0", _up_to(4, 7, 10, 13)),
    "worst": IndicatorLevels("0", (), _up_to(10, 15, 15)),
    "tone": IndicatorLevels("0", _up_to(1.5, 3, 4.5, 6), _up_to(2, 3, 4)),
    "gain bright": IndicatorLevels(
        "1", ((0.8, 1.1), (0.7, 1.2), (0.6, 1.3), (0.5, 1.4)), ((0.8, 1.1), (0.7, 1.2), (0.6, 1.3))
    ),
    "gain": IndicatorLevels("1", (), ((0.7, 1.3), (0.6, 1.4), (0.3, 1.6))),
    "white": IndicatorLevels("0", _up_to(2, 4, 6, 8), _up_to(3, 4, 5)),
    "noise": IndicatorLevels("0", _up_to(1, 2, 3, 4), _up_to(1.6, 2, 2.2)),
    "light": IndicatorLevels("0", _up_to(1)),
    "efficiency": IndicatorLevels("100", _from(90, 80, 70, 60), _from(85, 80, 70)),
    "half": IndicatorLevels("45 to 65", ((45, 65),)),
    "sharpening": IndicatorLevels("1", _up_to(1.02)),
    "misregistration": IndicatorLevels("0", _up_to(0.33, 0.5, 0.8)),
}


class IndicatorRow(NamedTuple):
    """One indicator: what, how much, its aim, and the level that the value alone would reach; "–" where not known."""

    name: str
    value: float
    unit: str
    aim: str
    fadgi: str
    iso: str

    def to_dict(self) -> dict[str, Any]:
        """Return the row for `--json`."""
        return self._asdict()


def indicator(key: str, name: str, value: float, unit: str) -> IndicatorRow:
    """Return a row of `LIMITS`: FADGI's limits are exclusive, ISO's inclusive.

    Examples
    --------
    >>> indicator("noise", "noise", 1.0, "L*")[4:], indicator("misregistration", "shift", 0.9, "px")[4:]
    (('3 stars', 'level A'), ('below 2 stars', '–'))
    """
    limits = LIMITS[key]
    stars = [4 - i for i, (low, high) in enumerate(limits.fadgi) if low < value < high]
    levels = ["ABC"[i] for i, (low, high) in enumerate(limits.iso) if low <= value <= high]
    known = 5 - len(limits.fadgi)
    fadgi = "none" if known == 1 else f"below {known} stars"
    if stars:
        fadgi = f"{stars[0]} star{'s' * (stars[0] > 1)}"
    return IndicatorRow(
        name,
        value,
        unit,
        limits.aim,
        fadgi if limits.fadgi else "–",
        (f"level {levels[0]}" if levels else "none") if limits.iso else "–",
    )


class WhiteEvenness(NamedTuple):
    """How even a white is before the flat field, in its worst channel.

    `least` over greatest level, 0 … 1; `spread`: standard deviation over mean of L*, the greatest being white.
    """

    least: float
    spread: float


def lightness_slope(luminance: np.ndarray) -> np.ndarray:
    """Return dL*/dY of CIELAB, white Y = 1.

    >>> lightness_slope(np.array([1.0, 0.001])).round(2).tolist()
    [38.67, 903.3]
    """
    y = np.maximum(np.asarray(luminance, float), 1e-9)
    return np.where(y > (6 / 29) ** 3, 116 / 3 * y ** (-2 / 3), (29 / 3) ** 3)


def lightness_spread(levels: np.ndarray) -> float:
    """Return the standard deviation over the mean of L*, of levels whose greatest is white.

    >>> round(lightness_spread(np.array([[1.0, 0.9], [0.9, 1.0]])), 4)
    0.0204
    """
    y = np.maximum(np.asarray(levels, float), 0)
    lightness = 116 * np.where(y > (6 / 29) ** 3, np.cbrt(y), y * (29 / 6) ** 2 / 3 + 4 / 29) - 16
    return float(lightness.std() / lightness.mean())
