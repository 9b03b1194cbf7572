"""What the codes of raw frames betray: how many there are, how far apart, and which curve made them.

Cameras that compress their raw files keep the codes 1 apart in the dark, where the noise is small, and
farther and farther apart in the light, where shot noise hides it.  Undone in the file, the curve is
seen in the gaps: y = knee + (x − knee) + bend·(x − knee)² has steps of sqrt(1 + 4·bend·(y − knee)).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

AT_A_TIME = 1 << 20  # codes: NumPy counts them as whole numbers of 8 bytes
MOST_CODES = 1 << 16
FEWEST_LEVELS = 64  # that a curve can be told from
WINDOW = 24  # gaps whose mean is one point of the fit
FILLED = 4  # pixels that a level must have: a rare one may stand beside one that was not met
MISFIT = 0.05  # of the gaps, in four windows of five
RECURS = 2  # times that the smallest gap must be met
SHIFTED = 4  # spacing from which codes are taken to stand at the upper end of their words
STRAY = 0.01  # share of codes that may stand between the others
FEWEST_SHIFTED = 4  # different codes from which a spacing is more than chance
STRETCHED = 1.4  # spacing of the widest part over the narrowest from which it is called a curve


@dataclass(frozen=True)
class Levels:
    """Distinct codes of a sensor.

    Parameters
    ----------
    count : int
        Distinct codes that were seen.
    lowest, highest : int
        Of them.
    spacing : float
        Counts from one code to the next, in the linear part.
    knee : float
        Counts up to which the codes are equally spaced; infinite where they are everywhere.
    bend : float
        Second-order coefficient of the curve beyond the knee, per `spacing`; 0 without one.

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
        beyond = (value - self.knee) / self.spacing
        return self.knee / self.spacing + (np.sqrt(1 + 4 * self.bend * beyond) - 1) / (
            2 * self.bend
        )


def count_codes(frames: Iterable[np.ndarray]) -> np.ndarray:
    """Return how often each code occurs, (65536,) int64; frames of 8- or 16-bit codes, one at a time.

    >>> count_codes([np.array([[0, 3, 3]], np.uint8)])[:4].tolist()
    [1, 0, 0, 2]
    """
    total = np.zeros(MOST_CODES, np.int64)
    for frame in frames:
        if frame.dtype not in (np.uint8, np.uint16):
            raise ValueError(f"codes are counted in uint8 and uint16, got {frame.dtype}")
        codes = frame.ravel()
        for start in range(0, codes.size, AT_A_TIME):
            found = np.bincount(codes[start : start + AT_A_TIME], minlength=1)
            total[: len(found)] += found
    return total


def find_step(frames: Iterable[np.ndarray]) -> float:
    """Return the counts from one code of some frames to the next; 0 where they are no whole numbers.

    Parameters
    ----------
    frames : iterable of ndarray
        Raw, as in the file; bright ones tell most. On a compression curve it is the step in the dark.

    Notes
    -----
    1 where that is not plain: fewer than 64 codes, or more than 1 % of the pixels between the others.

    Examples
    --------
    >>> find_step([np.arange(4096, dtype=np.uint16).repeat(4) * 16]), find_step([np.ones(4)])
    (16.0, 0.0)
    """
    whole = [frame for frame in frames if frame.dtype.kind in "ui"]
    histogram = count_codes(f for f in whole if f.dtype in (np.uint8, np.uint16))
    if not whole or not histogram.any():
        return 1.0 if whole else 0.0
    spacing = find_levels(histogram).spacing
    seen = np.flatnonzero(histogram)
    between = np.diff(seen, prepend=-MOST_CODES) < 0.9 * spacing
    return spacing if histogram[seen[between]].sum() <= 0.01 * histogram.sum() else 1.0


class Alignment(NamedTuple):
    """Where the codes of a frame stand in their words.

    Parameters
    ----------
    spacing : int or None
        Power of two of which the codes are multiples: 16 where 12 bits stand at the upper end of 16. None where
        too few different codes occur to tell.
    top, capacity : int
        Largest code that occurs, and what a word can hold, plus 1.
    """

    spacing: int | None
    top: int
    capacity: int

    def describe(self) -> str:
        """Return it in words.

        >>> Alignment(16, 60_000, 65_536).describe(), Alignment(1, 3_700, 65_536).describe()
        ('multiples of 16 up to 60000', 'codes 1 apart up to 3700')
        """
        apart = self.spacing or 1
        return (
            f"multiples of {apart} up to {self.top}"
            if apart > 1
            else f"codes 1 apart up to {self.top}"
        )

    def contradicts(self, other: Alignment) -> bool:
        """Whether one stands at the upper end of its words and the other at the lower.

        Codes of every value that reach higher than the lower end are averages of codes at the upper end.

        >>> left, right = Alignment(16, 60_000, 65_536), Alignment(1, 3_700, 65_536)
        >>> left.contradicts(right), left.contradicts(Alignment(1, 58_123, 65_536))
        (True, False)
        """
        if self.spacing is None or other.spacing is None:
            return False
        upper, lower = (self, other) if self.spacing > other.spacing else (other, self)
        shift = upper.spacing or 1
        return shift >= SHIFTED > (lower.spacing or 1) and lower.top * shift < lower.capacity


def find_alignment(frames: Iterable[np.ndarray]) -> Alignment | None:
    """Return where the codes of some frames stand; None where they are no whole numbers of 16 bits or more.

    A hundredth of the codes may stand elsewhere: saturated ones, and defects that a camera replaced.

    >>> find_alignment([np.arange(100, dtype=np.uint16) * 16])
    Alignment(spacing=16, top=1584, capacity=65536)
    """
    whole = [values for values in frames if values.dtype.kind in "ui" and values.dtype.itemsize > 1]
    if not whole:
        return None
    top = max(int(values.max(initial=0)) for values in whole)
    capacity = int(np.iinfo(whole[0].dtype).max) + 1
    count, spacing = sum(values.size for values in whole), 1
    while spacing < capacity:
        off = sum(int(np.count_nonzero(values & (2 * spacing - 1))) for values in whole)
        if off > STRAY * count:
            break
        spacing *= 2
    few = spacing > 1 and len(set().union(*map(set, map(_some_codes, whole)))) < FEWEST_SHIFTED
    return Alignment(None if few else spacing, top, capacity)


def _some_codes(values: np.ndarray) -> list[int]:
    return [int(code) for code in np.unique(values)[:FEWEST_SHIFTED]]


def find_levels(histogram: np.ndarray) -> Levels:
    """Describe the codes of one sensor.

    Parameters
    ----------
    histogram : ndarray, (65536,), int64
        From `count_codes`; frames that fill the range smoothly, such as whites with shading and
        objects, tell more than darks.

    Returns
    -------
    levels : Levels
        Without a curve where too few codes are filled to see one.

    Notes
    -----
    Gaps between filled codes; their squares grow by 4·bend a count beyond the knee.  A gap of about
    twice those around it is a code that was not met, and is left out.

    Examples
    --------
    >>> x = np.arange(683)
    >>> d80 = np.rint(x + 0.01565 * np.maximum(x - 215, 0) ** 2).astype(np.uint16)
    >>> found = find_levels(count_codes([np.repeat(d80, 9)]))
    >>> found.count, round(found.bend, 3), abs(found.knee - 215) < 10
    (683, 0.016, True)
    """
    seen = np.flatnonzero(histogram)
    if not len(seen):
        return Levels(0, 0, 0)
    plain = Levels(len(seen), int(seen[0]), int(seen[-1]))
    codes = np.flatnonzero(histogram >= FILLED)
    if len(codes) < FEWEST_LEVELS:
        return plain
    at, gap = _windows(codes)
    each, often = np.unique(np.diff(codes), return_counts=True)
    spacing = float(each[often >= RECURS].min(initial=round(float(gap.min()))))
    even = Levels(plain.count, plain.lowest, plain.highest, spacing)
    wide = gap > STRETCHED * spacing
    if np.count_nonzero(wide) < 4 or gap[-4:].min() < STRETCHED * spacing:
        return even
    from scipy.stats import theilslopes  # half a second to load, and few sensors have a curve

    # Robust, since a window may reach over a range that no frame fills.
    slope, start = theilslopes((gap[wide] / spacing) ** 2, at[wide])[:2]
    knee = (1 - start) / slope if slope > 0 else np.inf
    misfit = gap[wide] / np.sqrt(np.maximum(start + slope * at[wide], 1e-9)) / spacing - 1
    if not 0 <= knee < seen[-1] or np.quantile(np.abs(misfit), 0.8) > MISFIT:
        return even
    bend = float(slope) / 4 * spacing
    return Levels(plain.count, plain.lowest, plain.highest, spacing, float(knee), bend)


def _windows(codes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where windows of neighbouring codes stand, and the mean gap in each."""
    gaps = np.diff(codes).astype(float)
    middle = (codes[1:] + codes[:-1]) / 2
    parts = np.array_split(np.arange(len(gaps)), max(1, len(gaps) // WINDOW))
    at, mean = [], []
    for part in parts:
        kept = part[gaps[part] <= 1.5 * np.median(gaps[part]) + 0.5]
        at.append(middle[kept].mean())
        mean.append(gaps[kept].mean())
    return np.array(at), np.array(mean)
