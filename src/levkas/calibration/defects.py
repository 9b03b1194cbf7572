"""Detection and replacement of defective sensels: hot ones by darks, dead and stuck ones by whites.

Everything is judged against sensels of the same phase of the mosaic, since other phases see
another colour, and against neighbours, since glow and shading are no defects.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from levkas.calibration.patterns import as_pattern, split
from levkas.calibration.templates import CalibrationRefused, Template
from levkas.core.compiled import njit
from levkas.core.cube import Flag
from levkas.core.problems import Problem
from levkas.core.threads import in_threads

HOT = 10.0  # robust sigmas of the dark above the neighbours
LEAST_HOT = 5.0  # counts: below it subtraction of the dark is as good
DEAD = 0.5  # response that differs from the neighbours' by more than this share
MANY = 0.02  # more defects than this are no defects but a wrong frame


def find_defects(
    dark: Template | None,
    white: Template | None = None,
    pattern: str | Sequence[Sequence[str]] | None = None,
) -> np.ndarray:
    """Find sensels whose values cannot be trusted.

    Raises CalibrationRefused, E_VALUE where more than 2 % would be defects.

    Parameters
    ----------
    dark, white : Template, (h, w) or (h, w, b), or None
        What is missing is not judged.
    pattern : str or rows of names, optional
        Of a mosaic.

    Returns
    -------
    defects : ndarray of bool, shape of the templates

    Notes
    -----
    A sensel is hot where the dark is `HOT` robust standard deviations, and `LEAST_HOT` counts, above
    the median of its 3x3 neighbours of the same phase; dead where the white differs from theirs by
    more than the share `DEAD`. The spread of a dark is taken over a phase from the median absolute deviation, or where zeros
    hide it (a dark clipped at 0 has a MAD of 0) from its 90th percentile, at least one half count
    over the root of the shots; of a dark that was clipped and fitted at least what its levels may miss.

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
        if dark.fit is not None:
            floor = max(floor, float(np.sqrt(np.median(dark.fit.variance))))
        for mark, phase in zip(_planes(found, size), _planes(dark.mean, size), strict=True):
            mark |= _hot(phase, floor)
    if white is not None:
        lit = white.mean if dark is None or white.above_dark else white.mean - dark.mean
        for mark, phase in zip(_planes(found, size), _planes(lit, size), strict=True):
            mark |= _dead(phase)
    if np.mean(found) > MANY:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                "too many sensels appear defective",
                found=f"{np.mean(found):.1%}",
                expected=f"at most {MANY:.0%}",
                fix="Check the dark and the white: the pattern may be wrong, or a frame damaged.",
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


def _hot(phase: np.ndarray, floor: float) -> np.ndarray:
    above = phase - _local_median(phase)
    thin = above.ravel()[:: max(1, above.size // 200_000)]
    spread = 1.4826 * float(np.median(np.abs(thin)))
    spread = spread or float(np.quantile(np.abs(thin), 0.9)) / 1.645
    return above > max(HOT * max(spread, floor), LEAST_HOT)


def _dead(phase: np.ndarray) -> np.ndarray:
    around = _local_median(phase)
    return (around > 0) & (np.abs(phase - around) > DEAD * around)


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

    values, flags = np.array(values, np.float32), np.array(flags, np.uint8)
    variance = None if variance is None else np.array(variance, np.float32)
    where = np.argwhere(flags & Flag.DEFECT.value)
    if not len(where):
        return values, flags, variance
    if values.ndim == 2:
        where = np.column_stack([where, np.zeros(len(where), where.dtype)])
    shape = (*values.shape[:2], values.shape[2] if values.ndim == 3 else 1)
    numbers, spreads = np.empty(len(where), np.float32), np.empty(len(where), np.float32)
    marks = np.zeros(len(where), np.uint8)
    in_threads(
        _mend,
        len(where),
        values.reshape(shape),
        flags.reshape(shape),
        np.ascontiguousarray(where, np.int64),
        _size(pattern),
        (numbers, spreads, marks),
        worth=len(where) * (2 * RINGS + 1) ** 2,
    )
    at = tuple(where.T) if values.ndim == 3 else tuple(where.T[:2])
    values[at] = numbers
    flags[at] |= marks
    if variance is not None:
        variance[at] = spreads
    return values, flags, variance


DEFECT, NEAR = np.uint8(Flag.DEFECT.value), np.uint8(Flag.NEAR.value)
RINGS = 4
ENOUGH = 3  # sound neighbours for a median; fewer only where no larger ring has more


@njit(cache=True)
def _mend(start, stop, values, flags, where, period, out):  # type: ignore[no-untyped-def]
    """Fill median, variance of prediction and extra flags for each (y, x, band) of `where`."""
    height, width, _ = values.shape
    rows, columns = period
    numbers, spreads, marks = out
    sound = np.empty((2 * RINGS + 1) ** 2)
    for i in range(start, stop):
        y, x, band = where[i, 0], where[i, 1], where[i, 2]
        count, total = 0, 0.0
        for ring in range(1, RINGS + 1):
            for v in range(-ring, ring + 1):
                for h in range(-ring, ring + 1):
                    if max(abs(v), abs(h)) != ring:
                        continue
                    at, across = y + v * rows, x + h * columns
                    if at < 0 or at >= height or across < 0 or across >= width:
                        continue
                    flag = flags[at, across, band]
                    value = values[at, across, band]
                    if flag & DEFECT or value != value:
                        continue
                    sound[count] = value
                    total += value
                    count += 1
                    if flag:
                        marks[i] |= NEAR
            if count >= ENOUGH:
                break
        if count == 0:
            numbers[i] = np.nan
            spreads[i] = np.nan
            continue
        mean, spread = total / count, 0.0
        for k in range(count):
            spread += (sound[k] - mean) ** 2
        spreads[i] = spread / (count - 1) * (1 + 1 / count) if count > 1 else np.nan
        for k in range(1, count):  # by insertion: there are few
            value, place = sound[k], k
            while place > 0 and sound[place - 1] > value:
                sound[place] = sound[place - 1]
                place -= 1
            sound[place] = value
        numbers[i] = (sound[(count - 1) // 2] + sound[count // 2]) / 2
