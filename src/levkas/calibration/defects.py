"""Detection and replacement of defective sensels: hot ones by darks, dead and stuck ones by whites.

Everything is judged against sensels of the same phase of the mosaic, since other phases see another colour, and against
neighbours, since glow and shading are no defects.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from levkas.calibration.findings import refusal
from levkas.calibration.patterns import as_pattern, split
from levkas.calibration.templates import Template
from levkas.core.cube import Flag

HOT, LEAST_HOT = 10.0, 5.0
"""Robust sigmas of the dark above the neighbours, and counts, below which subtraction of the dark is as good."""
DEAD = 0.5
"""Response that differs from the neighbours' by more than this share; what differs less a flat field mends."""
MANY = 0.02
"""More defects than this share are no defects but a wrong frame."""
RINGS, ENOUGH = 4, 3
"""Periods within which sound sensels are looked for, and how many a median needs; fewer only where no larger ring has more."""
Pattern = str | Sequence[Sequence[str]] | None


def find_defects(
    dark: Template | None, white: Template | None = None, pattern: Pattern = None
) -> np.ndarray:
    """Find sensels whose values cannot be trusted, bool like the templates, (h, w) or (h, w, b); what is None is not judged.

    A sensel is hot where the dark is `HOT` robust standard deviations, and `LEAST_HOT` counts, above the median of its 3x3
    neighbours of the same phase; dead where the white differs from theirs by more than the share `DEAD`. The spread of a dark
    is taken over a phase from the median absolute deviation, or where zeros hide it (a dark clipped at 0 has a MAD of 0) from
    its 90th percentile, at least one half count over the root of the shots; of a dark that was clipped and fitted at least
    what its levels may miss.

    Raises CalibrationRefused, E_VALUE where more than 2 % would be defects.

    >>> frame = np.full((9, 9), 64)
    >>> frame[4, 4] = 900
    >>> from levkas.calibration.templates import average
    >>> np.argwhere(find_defects(average([frame]))).tolist()
    [[4, 4]]
    """
    template = dark if dark is not None else white
    if template is None:
        raise ValueError("find_defects needs a dark or a white")
    found = np.zeros(template.mean.shape, bool)
    if dark is not None:
        floor = 0.5 / np.sqrt(dark.count)
        if dark.fit is not None:
            floor = max(floor, float(np.sqrt(np.median(dark.fit.variance))))
        for mark, phase in zip(*(_planes(a, pattern) for a in (found, dark.mean)), strict=True):
            above = phase - _local_median(phase)
            thin = np.abs(above.ravel()[:: max(1, above.size // 200_000)])
            spread = 1.4826 * float(np.median(thin)) or float(np.quantile(thin, 0.9)) / 1.645
            mark |= above > max(HOT * max(spread, floor), LEAST_HOT)
    if white is not None:
        lit = white.mean if dark is None or white.above_dark else white.mean - dark.mean
        for mark, phase in zip(*(_planes(a, pattern) for a in (found, lit)), strict=True):
            around = _local_median(phase)
            mark |= (around > 0) & (np.abs(phase - around) > DEAD * around)
    if np.mean(found) > MANY:
        raise refusal("many_defects", number=float(np.mean(found)), limit=MANY)
    return found


def _size(pattern: Pattern) -> tuple[int, int]:
    rows = ((None,),) if pattern is None else as_pattern(pattern)
    return len(rows), len(rows[0])


def _planes(array: np.ndarray, pattern: Pattern) -> list[np.ndarray]:
    """Return views of what may be compared: phases of a mosaic, or bands of a cube."""
    if array.ndim == 3:
        return [array[:, :, band] for band in range(array.shape[2])]
    return split(array, *_size(pattern))


def _local_median(plane: np.ndarray) -> np.ndarray:
    return cv2.medianBlur(np.ascontiguousarray(plane, np.float32), 3)


def replace_defects(
    values: np.ndarray, flags: np.ndarray, variance: np.ndarray | None, pattern: Pattern = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Put the median of sound neighbours of the same phase or band where flags say DEFECT; new arrays, (h, w) or (h, w, b).

    The nearest ring of the same phase that holds three sound sensels or more is used. DEFECT stays, with NEAR where a
    neighbour that took part was flagged. The variance is that of predicting one sound neighbour from the others: their own
    spread, which holds noise and texture alike, times 1 + 1/n. Where no sound sensel lies within four periods the value is
    NaN.
    """
    values, flags = np.array(values, np.float32), np.array(flags, np.uint8)
    variance = None if variance is None else np.array(variance, np.float32)
    left = np.argwhere(flags & Flag.DEFECT.value)
    sound_flags, period = flags.copy(), _size(pattern)
    known = np.where(flags & Flag.DEFECT.value, np.float32(np.nan), values) if len(left) else values
    for ring in range(1, RINGS + 1 if len(left) else 1):
        some, marks = _neighbours(known, sound_flags, left, period, ring)
        count = np.isfinite(some).sum(1)
        done = (count >= ENOUGH) | (ring == RINGS)
        some, n, at = np.sort(some[done], axis=1), count[done], tuple(left[done].T)
        each, whole = np.arange(len(n)), np.maximum(n, 1)
        values[at] = (some[each, (whole - 1) // 2] + some[each, whole // 2]) / 2
        flags[at] |= np.where(marks[done], np.uint8(Flag.NEAR), np.uint8(0))
        if variance is not None:
            apart = some - np.nansum(some, axis=1, keepdims=True) / whole[:, None]
            with np.errstate(invalid="ignore", divide="ignore"):
                variance[at] = np.nansum(apart**2, axis=1) / (n - 1) * (1 + 1 / n)
        left = left[~done]
    return values, flags, variance


def _neighbours(
    known: np.ndarray, flags: np.ndarray, where: np.ndarray, period: tuple[int, int], ring: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the sensels of some rings of the same phase around places, (n, k) float64, NaN where none is sound; whether one is flagged."""
    steps = np.array([s for s in np.ndindex(2 * ring + 1, 2 * ring + 1) if s != (ring, ring)])
    at = where[:, None, :2] + (steps - ring) * period
    inside = np.asarray(((at >= 0) & (at < known.shape[:2])).all(2))
    at = np.where(inside[..., None], at, 0)
    place = (at[..., 0], at[..., 1], *(where[:, 2:].T[..., None]))
    some = np.where(inside, known[place].astype(float), np.nan)
    return some, ((flags[place] > 0) & np.isfinite(some)).any(1)
