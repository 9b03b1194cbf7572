"""Charts in finished photographs: which curve encodes their values, and what their codes resolve."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.colour.srgb import decode_srgb

if TYPE_CHECKING:
    from levkas.quality.targets.charts import Chart

DARKEST = 0.01
"""Relative luminance of a grey below which flare and black point hide the curve."""


class Curve(NamedTuple):
    """How a photograph encodes light: by sRGB's curve, or linearly.

    `slope` is that of log value over log luminance along the grey scale, after decoding: 1 where the
    curve is the photograph's own.
    """

    encoded: bool
    slope: float

    @property
    def note(self) -> str:
        """What the report says of it."""
        how = "encoded as sRGB" if self.encoded else "linear"
        return f"a finished photograph, {how} by its grey patches (slope {self.slope:.2f} after decoding)"

    def decode(self, values: np.ndarray) -> np.ndarray:
        """Return light, 0 … 1, from values 0 … 1."""
        return decode_srgb(values) if self.encoded else values

    def steps(self, means: np.ndarray, codes: int) -> np.ndarray:
        """Return what a step from code to code is of the light, like `means` (values 0 … 1 of patches)."""
        low, high = np.clip(means - 0.5 / codes, 0, 1), np.clip(means + 0.5 / codes, 0, 1)
        return self.decode(high) - self.decode(low)


def find_curve(means: np.ndarray, chart: Chart) -> Curve:
    """Find from the grey scale of a chart whether a photograph is linear or encoded as sRGB.

    Examples
    --------
    >>> from levkas.quality.targets.charts import CHARTS
    >>> chart = CHARTS["ColorChecker24"]
    >>> light = chart.luminances[:, None]
    >>> find_curve(light, chart).encoded, find_curve(light ** (1 / 2.2), chart).encoded
    (False, True)
    """
    greys = [g for g in chart.greys if chart.luminances[g] > DARKEST]
    x = np.log(chart.luminances[greys])
    found = []
    for encoded in (True, False):
        value = Curve(encoded, 1.0).decode(means[greys].mean(1))
        y = np.log(np.maximum(value, 1e-6))
        found.append(Curve(encoded, float(np.polyfit(x, y, 1)[0])))
    return min(found, key=lambda curve: abs(np.log(max(curve.slope, 1e-3))))
