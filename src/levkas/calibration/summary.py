"""What one decoding of a frame leaves: a sample of its codes, by which full scale, spacing, bits and alignment are found."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from levkas.calibration.codes import Alignment, find_alignment
from levkas.calibration.patterns import thin_periods

SAMPLED, ROWS = 1 << 18, 20
"""Values of a sample; rows that are taken together, whole periods of mosaics of up to 5."""


@dataclass(frozen=True, eq=False)
class Summary:
    """What is kept of a frame.

    Parameters
    ----------
    sample : ndarray, (h, w) or (h, w, b), the frame's dtype
        Groups of whole rows, evenly over it.
    top : float
        Its largest value; 0 where it holds nothing.
    constant : float, optional
        The one value of all its pixels, where they have no other.
    codes : ndarray, (n,)
        Values of the sample; where pixels may hold nothing the others.
    """

    sample: np.ndarray
    top: float
    constant: float | None
    codes: np.ndarray

    @cached_property
    def alignment(self) -> Alignment | None:
        """Where the codes stand in their words; None where they hold nothing."""
        return find_alignment([self.codes])


def summarise(values: np.ndarray, *, stored: np.dtype | None = None) -> Summary:
    """Return what is kept of a frame of a real dtype.

    `stored` is the dtype of its file where pixels that hold nothing were made NaN.

    >>> one = summarise(np.arange(12, dtype=np.uint16).reshape(3, 4))
    >>> one.top, one.constant, summarise(np.full((4, 4), 7)).constant
    (11.0, None, 7.0)
    """
    sample = thin_periods(values, ROWS, SAMPLED).copy()
    codes = sample.ravel()
    if stored is not None and values.dtype.kind == "f":
        codes = codes[np.isfinite(codes)].astype(stored)
    first = values.flat[0]
    same = bool(np.all(values[0] == first) and np.all(values == first))
    top = values.max(initial=0) if values.dtype.kind in "ui" else 0.0
    return Summary(sample, float(top), float(first) if same else None, codes)


def summarise_lines(lines: np.ndarray, middle: np.ndarray, stored: np.dtype | None) -> Summary:
    """Return what is kept of a scan, by lines evenly over it and by neighbouring lines in its middle."""
    found, codes = summarise(lines, stored=stored), summarise(middle, stored=stored).codes
    return Summary(found.sample, max(found.top, float(codes.max(initial=0))), None, codes)
