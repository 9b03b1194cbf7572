"""What the codes of raw frames betray: how many there are, how far apart, and which curve made them.

Cameras that compress their raw files keep the codes 1 apart in the dark, where the noise is small, and
farther and farther apart in the light, where shot noise hides it.  Undone in the file, the curve is
measured in the gaps: y = knee + (x − knee) + bend·(x − knee)² has steps of sqrt(1 + 4·bend·(y − knee)).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from levkas.readers.compared_facts import Severity

AT_A_TIME = 1 << 20  # codes: NumPy counts them as whole numbers of 8 bytes
MOST_CODES = 1 << 16
FEWEST_LEVELS = 64  # that show a curve
WINDOW = 24  # gaps whose mean is one point of the fit
FILLED = 4  # pixels that a level must have: a rare one may stand beside one that was not met
MISFIT = 0.05  # of the gaps, in four windows of five
RECURS = 2  # times that the smallest gap must be met
LEAST_SHIFT = 2  # spacing over another's from which codes stand at the upper end of their words
SURE_SHIFT = 4  # the same, where no image editor of 15 bits may have made them
LEAST_COUNTS = 16  # that no fraction of a full scale reaches: gloss is 3 or 4 times a white
STRAY = 0.01  # share of codes that may stand between the others
FEWEST_SHIFTED = 4  # different codes, all even, that are more than chance
FEWEST_SPACED = 16  # different codes of any other spacing that are more than chance
DENSE = 0.25  # share of its multiples that must occur
STRETCHED = 1.4  # spacing of the widest part over the narrowest from which it is called a curve


@dataclass(frozen=True)
class Levels:
    """Distinct codes of a sensor.

    Parameters
    ----------
    count : int
        Distinct codes that occur.
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
        Raw, as in the file; bright ones show most. On a compression curve it is the step in the dark.

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
    present = np.flatnonzero(histogram)
    between = np.diff(present, prepend=-MOST_CODES) < 0.9 * spacing
    return spacing if histogram[present[between]].sum() <= 0.01 * histogram.sum() else 1.0


class Alignment(NamedTuple):
    """Where the codes of a frame stand in their words.

    Parameters
    ----------
    spacing : int or None
        Of neighbouring codes: 16 where 12 bits stand at the upper end of 16. None where that does not show: too few
        different codes, 8 bits, floats that are no whole numbers.
    top : float
        Largest code that occurs.
    capacity : int
        What a word can hold, plus 1; 1 of floats between 0 and 1, fractions of a full scale.
    """

    spacing: int | None
    top: float
    capacity: int

    def describe(self) -> str:
        """Return it in words.

        >>> Alignment(16, 60_000, 65_536).describe(), Alignment(None, 0.82, 1).describe()
        ('codes 16 apart up to 60000', 'fractions up to 0.82')
        """
        if self.spacing is None:
            return f"{'fractions' if self.capacity == 1 else 'values'} up to {self.top:.4g}"
        return f"codes {self.spacing} apart up to {self.top:.0f}"

    def compare(self, other: Alignment) -> Severity:
        """Compare with another frame's: counts by their fractions, one end of a word by the other end, are refused.

        Codes of every value that reach higher than the lower end are averages of codes at the upper end. Codes 2 or 3
        apart that reach beyond half of what words can hold may be those of an image editor of 15 bits, and are noted.

        >>> left, right = Alignment(16, 60_000, 65_536), Alignment(1, 3_700, 65_536)
        >>> left.compare(right), left.compare(Alignment(1, 58_123, 65_536)), Alignment(None, 0.82, 1).compare(right)
        ('refused', 'same', 'refused')
        """
        if (self.capacity == 1) != (other.capacity == 1):
            counts = other if self.capacity == 1 else self
            return (
                "refused"
                if counts.top > (LEAST_COUNTS if counts.spacing is None else 1)
                else "same"
            )
        if self.spacing is None or other.spacing is None:
            return "same"
        upper, lower = (self, other) if self.spacing > other.spacing else (other, self)
        shift = (upper.spacing or 1) / (lower.spacing or 1)
        if shift < LEAST_SHIFT or lower.top * shift >= lower.capacity:
            return "same"
        editor = shift < SURE_SHIFT and upper.top > upper.capacity / 2
        return "noted" if editor else "refused"


def find_alignment(frames: Iterable[np.ndarray]) -> Alignment | None:
    """Return where the codes of some frames stand; None where they hold nothing.

    A hundredth of the codes may stand elsewhere: saturated ones, and defects that a camera replaced. Floats that are
    whole numbers are codes of 16 bits.

    >>> find_alignment([np.arange(100, dtype=np.uint16) * 16])
    Alignment(spacing=16, top=1584, capacity=65536)
    >>> find_alignment([np.arange(1, 100) / 100])
    Alignment(spacing=None, top=0.99, capacity=1)
    """
    values = np.concatenate([frame.ravel() for frame in frames] or [np.empty(0)])
    if values.dtype.kind == "f":
        values = values[np.isfinite(values)]
        if not values.any():
            return None
        if np.any(values != np.rint(values)):
            return _of_fractions(values)
        values = values.astype(np.int64)
        capacity = MOST_CODES
    else:
        capacity = int(np.iinfo(values.dtype).max) + 1
    if not values.size:
        return None
    top = int(values.max())
    return Alignment(None if capacity < MOST_CODES // 2 else _spacing(values), top, capacity)


def _of_fractions(values: np.ndarray) -> Alignment:
    """Return the alignment of floats that are no whole numbers: fractions of a full scale, or averages of counts."""
    outside = np.count_nonzero((values < 0) | (values > 1))
    return Alignment(None, float(values.max()), MOST_CODES if outside > STRAY * values.size else 1)


def _spacing(values: np.ndarray) -> int | None:
    """Return the distance of neighbouring codes, all but a hundredth of the pixels; None where it is chance."""
    if values.min() >= 0 and values.max() < MOST_CODES:
        histogram = count_codes([values.astype(np.uint16)])
        codes = np.flatnonzero(histogram)
        count = histogram[codes]
    else:
        codes, count = np.unique(values.astype(np.int64), return_counts=True)
    shift = 1
    while shift < MOST_CODES and count[codes % (2 * shift) != 0].sum() <= STRAY * values.size:
        shift *= 2
    if np.count_nonzero(codes % shift == 0) < FEWEST_SHIFTED:
        return None
    rarest = np.argsort(count, kind="stable")
    kept = np.sort(codes[rarest[np.cumsum(count[rarest]) > STRAY * values.size]])
    gap = int(np.diff(kept).min(initial=MOST_CODES))
    dense = len(kept) >= FEWEST_SPACED and len(kept) * gap >= DENSE * (kept[-1] - kept[0])
    return max(shift, gap) if dense else shift


def find_levels(histogram: np.ndarray) -> Levels:
    """Describe the codes of one sensor.

    Parameters
    ----------
    histogram : ndarray, (65536,), int64
        From `count_codes`; frames that fill the range smoothly, such as whites with shading and
        objects, show more than darks.

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
    present = np.flatnonzero(histogram)
    if not len(present):
        return Levels(0, 0, 0)
    plain = Levels(len(present), int(present[0]), int(present[-1]))
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
    if not 0 <= knee < present[-1] or np.quantile(np.abs(misfit), 0.8) > MISFIT:
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
