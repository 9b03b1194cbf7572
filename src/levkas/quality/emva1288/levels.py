"""Codes of a sensor on a line or on a curve of compression.

Cameras that compress their raw files keep the codes 1 apart in the dark, and farther and farther apart in the light, where
shot noise hides it. Undone in the file, the curve shows in the gaps: y = knee + (x − knee) + bend·(x − knee)² has steps of
√(1 + 4·bend·(y − knee)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

FEWEST_LEVELS, WINDOW, FILLED = (
    64,
    24,
    4,
)  # that show a curve; gaps of a point of it; pixels of a level
MISFIT, STRETCHED = (
    0.05,
    1.4,
)  # of the gaps, in four windows of five; widest over narrowest spacing of a curve


@dataclass(frozen=True)
class Levels:
    """Distinct codes of a sensor: how many occur, the lowest and highest, counts from one to the next in the linear part.

    `knee` is where they are no longer equally spaced, `bend` the second-order coefficient of the curve beyond, per `spacing`.

    Examples
    --------
    The curve of a Nikon D80, 683 codes for 12 bits:

    >>> d80 = Levels(683, 0, 4095, 1.0, 215.0, 0.01565)
    >>> d80.between(0, 4095), round(float(d80.step(4095)), 1)
    (683, 15.6)
    """

    count: int
    lowest: int
    highest: int
    spacing: float = 1.0
    knee: float = float("inf")
    bend: float = 0.0

    @property
    def curved(self) -> bool:
        """Whether the codes lie on a compression curve."""
        return self.bend > 0

    def step(self, value: float | np.ndarray) -> np.ndarray:
        """Return the distance of neighbouring codes at a value in counts."""
        beyond = np.maximum(np.asarray(value, float) - self.knee, 0.0)
        return self.spacing * np.sqrt(1 + 4 * self.bend * beyond / self.spacing)

    def quantisation(self, value: float | np.ndarray) -> np.ndarray:
        """Return the variance of rounding to a code, step²/12, counts²."""
        return self.step(value) ** 2 / 12

    def between(self, low: float, high: float) -> int:
        """Return how many codes the camera can have from `low` to `high`, both included."""
        half = 0.5 if self.curved else 0.0  # where the curve ends is known to about a code
        return int(self._index(high) + half) - int(self._index(low) + half) + 1

    def _index(self, value: float) -> float:
        if not self.curved or value <= self.knee:
            return value / self.spacing
        root = np.sqrt(1 + 4 * self.bend * (value - self.knee) / self.spacing)
        return self.knee / self.spacing + (root - 1) / (2 * self.bend)


def find_levels(histogram: np.ndarray) -> Levels:
    """Describe the codes of one sensor by `count_codes` of frames that fill the range smoothly.

    By gaps between codes of 4 pixels or more, 24 together: their squares grow by 4·bend a count beyond the knee. A gap of
    twice those around it is a code that was not met.

    >>> from levkas.calibration.codes import count_codes
    >>> x = np.arange(683)
    >>> d80 = np.rint(x + 0.01565 * np.maximum(x - 215, 0) ** 2).astype(np.uint16)
    >>> found = find_levels(count_codes([np.repeat(d80, 9)]))
    >>> found.count, round(found.bend, 3), abs(found.knee - 215) < 10
    (683, 0.016, True)
    """
    present = np.flatnonzero(histogram)
    if not len(present):
        return Levels(0, 0, 0)
    ends = len(present), int(present[0]), int(present[-1])
    codes = np.flatnonzero(histogram >= FILLED)
    if len(codes) < FEWEST_LEVELS:
        return Levels(*ends)
    at, gap = _windows(codes)
    each, often = np.unique(np.diff(codes), return_counts=True)
    spacing = float(each[often >= 2].min(initial=round(float(gap.min()))))
    wide = gap > STRETCHED * spacing
    if np.count_nonzero(wide) < 4 or gap[-4:].min() < STRETCHED * spacing:
        return Levels(*ends, spacing)
    from scipy.stats import theilslopes  # half a second to load, and few sensors have a curve

    # Robust, since a window may reach over a range that no frame fills.
    slope, start = theilslopes((gap[wide] / spacing) ** 2, at[wide])[:2]
    knee = (1 - start) / slope if slope > 0 else np.inf
    misfit = gap[wide] / np.sqrt(np.maximum(start + slope * at[wide], 1e-9)) / spacing - 1
    if not 0 <= knee < present[-1] or np.quantile(np.abs(misfit), 0.8) > MISFIT:
        return Levels(*ends, spacing)
    return Levels(*ends, spacing, float(knee), float(slope) / 4 * spacing)


def _windows(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where windows of neighbouring codes stand, and the mean gap in each."""
    gaps, middle = np.diff(codes).astype(float), (codes[1:] + codes[:-1]) / 2
    at, mean = [], []
    for part in np.array_split(np.arange(len(gaps)), max(1, len(gaps) // WINDOW)):
        kept = part[gaps[part] <= 1.5 * np.median(gaps[part]) + 0.5]
        at.append(middle[kept].mean())
        mean.append(gaps[kept].mean())
    return np.array(at), np.array(mean)
