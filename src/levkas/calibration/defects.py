"""Defective sensels: hot ones from darks, dead and stuck ones from whites, and their replacement.

Everything is judged against sensels of the same phase of the mosaic, since other phases see
another colour, and against neighbours, since glow and shading are no defects.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from levkas.calibration.patterns import as_pattern, split
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.core.cube import Flag
from levkas.core.problems import Problem

HOT = 10.0  # robust sigmas of the dark above the neighbours
LEAST_HOT = 5.0  # counts: below it subtraction of the dark is as good
DEAD = 0.5  # response that differs from the neighbours' by more than this share
MANY = 0.02  # more defects than this are no defects but a wrong frame


def find_defects(
    dark: Template | None,
    white: Template | None = None,
    pattern: str | Sequence[Sequence[str]] | None = None,
    *,
    hot: float = HOT,
    least_hot: float = LEAST_HOT,
    dead: float = DEAD,
) -> np.ndarray:
    """Find sensels whose values cannot be trusted.

    Parameters
    ----------
    dark, white : Template, (h, w) or (h, w, b), or None
        What is missing is not judged.
    pattern : str or rows of names, optional
        Of a mosaic.
    hot : float
        Robust standard deviations above the median of the 3x3 neighbours of the same phase.
    least_hot : float
        Counts that a hot sensel is above them at least.
    dead : float
        A white that differs from that median by more than this share of it.

    Returns
    -------
    defects : ndarray of bool, shape of the templates

    Raises
    ------
    CalibrationRefused
        E_VALUE where more than 2 % would be defects.

    Notes
    -----
    The spread of a dark is taken over a phase from the median absolute deviation, or where zeros
    hide it (a dark clipped at 0 has a MAD of 0) from its 90th percentile, at least one half count
    over the root of the shots.

    Examples
    --------
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
    size = _size(pattern)
    if dark is not None:
        floor = 0.5 / np.sqrt(dark.count)
        for mark, phase in zip(_planes(found, size), _planes(dark.mean, size), strict=True):
            mark |= _hot(phase, hot, least_hot, floor)
    if white is not None:
        lit = white.mean if dark is None or white.above_dark else white.mean - dark.mean
        for mark, phase in zip(_planes(found, size), _planes(lit, size), strict=True):
            mark |= _dead(phase, dead)
    if np.mean(found) > MANY:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                "too many sensels look defective",
                found=f"{np.mean(found):.1%}",
                expected=f"at most {MANY:.0%}",
                fix="Look at the dark and the white: is the pattern right, is a frame broken?",
            )
        )
    return found


def _size(pattern: str | Sequence[Sequence[str]] | None) -> tuple[int, int]:
    if pattern is None:
        return 1, 1
    rows = as_pattern(pattern)
    return len(rows), len(rows[0])


def _planes(array: np.ndarray, size: tuple[int, int]) -> list[np.ndarray]:
    """Return views of what may be compared: phases of a mosaic, or bands of a cube."""
    if array.ndim == 3:
        return [array[:, :, band] for band in range(array.shape[2])]
    return split(array, *size)


def _hot(phase: np.ndarray, hot: float, least: float, floor: float) -> np.ndarray:
    above = phase - _local_median(phase)
    thin = above.ravel()[:: max(1, above.size // 200_000)]
    spread = 1.4826 * float(np.median(np.abs(thin)))
    spread = spread or float(np.quantile(np.abs(thin), 0.9)) / 1.645
    return above > max(hot * max(spread, floor), least)


def _dead(phase: np.ndarray, dead: float) -> np.ndarray:
    around = _local_median(phase)
    return (around > 0) & (np.abs(phase - around) > dead * around)


def _local_median(plane: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.medianBlur(np.ascontiguousarray(plane, np.float32), 3)


def replace_defects(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    pattern: str | Sequence[Sequence[str]] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Put the median of sound neighbours where flags say DEFECT.

    Parameters
    ----------
    values : ndarray, (h, w) or (h, w, b), float32
    flags : ndarray like `values`, uint8
    variance : ndarray like `values`, float32, or None
    pattern : str or rows of names, optional
        Of a mosaic: neighbours are those of the same phase.

    Returns
    -------
    values, flags, variance
        New arrays. DEFECT stays, with NEAR where a neighbour that took part was flagged. The
        variance is that of predicting one sound neighbour from the others: their own spread,
        which holds noise and texture alike, times 1 + 1/n. Where no sound sensel lies within
        four periods the value is NaN.

    Notes
    -----
    The nearest ring of the same phase that holds three sound sensels or more is used; in a cube
    neighbours are those of the same band.
    """
    from levkas.calibration.defects_kernel import mend

    values, flags = np.array(values, np.float32), np.array(flags, np.uint8)
    variance = None if variance is None else np.array(variance, np.float32)
    where = np.argwhere(flags & Flag.DEFECT.value)
    if not len(where):
        return values, flags, variance
    if values.ndim == 2:
        where = np.column_stack([where, np.zeros(len(where), where.dtype)])
    shape = (*values.shape[:2], values.shape[2] if values.ndim == 3 else 1)
    numbers, spreads, marks = mend(
        values.reshape(shape), flags.reshape(shape), np.ascontiguousarray(where), *_size(pattern)
    )
    at = tuple(where.T) if values.ndim == 3 else tuple(where.T[:2])
    values[at] = numbers
    flags[at] |= marks
    if variance is not None:
        variance[at] = spreads
    return values, flags, variance
