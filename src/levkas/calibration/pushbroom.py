"""Line scanners: templates averaged along the scan, and overlapping strips joined to one frame.

A push-broom camera has one line of sensels: its dark and white are that line, seen many times.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.flatfield import Calibrated
from levkas.calibration.templates import CalibrationRefused, Template, average
from levkas.core.cube import Flag
from levkas.core.problems import Problem

LEAST_OVERLAP = 8  # samples
LEAST_CORRELATION = 0.7
JUMP_SHIFT = 16  # lines that one strip may start later than the next, at most
SCOUT_LINES = 2048


def average_lines(
    blocks: Iterable[np.ndarray],
    *,
    saturation: float | None = None,
    black_clip: float | None = 0.0,
    exposure_s: float | None = None,
) -> Template:
    """Average a push-broom dark or white along the scan.

    Parameters
    ----------
    blocks : iterable of ndarray, (lines, samples, bands)
        Consecutive lines, in blocks of any height; one block at a time is held.
    saturation, black_clip, exposure_s
        As in `templates.average`.

    Returns
    -------
    template : Template, (1, samples, bands)
        `count` is the number of lines, `variance` that of one line over the scan.

    Examples
    --------
    >>> t = average_lines([np.array([[[1], [5]], [[3], [7]]], np.uint16)])
    >>> t.mean.tolist(), t.count
    ([[[2.0], [6.0]]], 2)
    """
    lines: Iterator[np.ndarray] = (line[None] for block in blocks for line in block)
    return average(lines, saturation=saturation, black_clip=black_clip, exposure_s=exposure_s)


@dataclass(frozen=True)
class Seam:
    """Where two strips meet.

    Parameters
    ----------
    overlap : int
        Samples that both strips saw.
    shift : int
        Lines: line y of the left strip is line y − shift of the right one.
    correlation : float
        Of the band mean over the overlap.
    difference : ndarray, (b,), float64
        Right over left − 1, medians over the overlap.
    rms : float
        Of the band mean's relative difference over the overlap.
    """

    overlap: int
    shift: int
    correlation: float
    difference: np.ndarray
    rms: float


def join_strips(
    strips: Sequence[Calibrated],
    *,
    overlaps: Sequence[int] | None = None,
    blend: bool = False,
    least_correlation: float = LEAST_CORRELATION,
) -> tuple[Calibrated, tuple[Seam, ...]]:
    """Join overlapping strips of a line scan, left to right in the order given.

    Parameters
    ----------
    strips : sequence of Calibrated, (lines, samples, bands)
        Of one camera; lines may differ in number and start.
    overlaps : sequence of int, optional
        Samples that each strip shares with the next. Default: found by correlation.
    blend : bool
        False: cut in the middle of the overlap, each pixel from one strip as it is. True: a
        linear change over from one to the other, which hides a difference and doubles detail
        where strips do not match to the pixel.
    least_correlation : float
        Of a found overlap; below it the join is refused.

    Returns
    -------
    joined : Calibrated
        Whole pixels are moved only, nothing is resampled. Lines are those of the first strip;
        where another has none, the value is NaN and OUTSIDE is set.
    seams : tuple of Seam

    Raises
    ------
    CalibrationRefused
        E_SIZE where bands differ, E_STRIPS where no overlap can be believed.
    """
    first = strips[0]
    if any(strip.values.shape[2:] != first.values.shape[2:] for strip in strips):
        raise CalibrationRefused(
            Problem(
                "E_SIZE",
                "strips of one scan have the same bands",
                found=", ".join(str(strip.values.shape) for strip in strips),
                expected="(lines, samples, bands) of equal bands",
            )
        )
    if overlaps is not None and len(overlaps) != len(strips) - 1:
        raise CalibrationRefused(
            Problem("E_VALUE", "overlaps", found=len(overlaps), expected=len(strips) - 1)
        )
    joined, seams, top = first, [], 0
    for index, right in enumerate(strips[1:]):
        left = strips[index]
        given = None if overlaps is None else overlaps[index]
        seam = _measure(left, right, given, least_correlation, index)
        top += seam.shift
        joined = _append(joined, right, seam.overlap, top, blend)
        seams.append(seam)
    return joined, tuple(seams)


def _measure(
    left: Calibrated, right: Calibrated, given: int | None, least: float, index: int
) -> Seam:
    """Find how `right` continues `left`."""
    a, b = (_grey(strip) for strip in (left, right))
    if given is not None:
        if not 1 <= given <= min(a.shape[1], b.shape[1]):
            raise CalibrationRefused(_no_overlap(index, f"an overlap of {given} was given"))
        overlap, shift = given, _best_shift(a[:, -given:], b[:, :given])
    else:
        overlap, shift = _search(a, b)
    one, two = _common_lines(a[:, -overlap:], b[:, :overlap], shift)
    correlation = _correlation(one, two)
    if given is None and not correlation >= least:
        raise CalibrationRefused(
            _no_overlap(index, f"best: {overlap} samples at a correlation of {correlation:.2f}")
        )
    parts = _common_lines(left.values[:, -overlap:], right.values[:, :overlap], shift)
    usable = _common_lines(left.flags[:, -overlap:], right.flags[:, :overlap], shift)
    clean = (usable[0] | usable[1]) == 0
    medians = [np.nanmedian(np.where(clean, part, np.nan), axis=(0, 1)) for part in parts]
    rms = np.sqrt(np.nanmean((two - one) ** 2)) / np.nanmean(np.abs(one))
    return Seam(overlap, shift, correlation, medians[1] / medians[0] - 1, float(rms))


def _grey(strip: Calibrated) -> np.ndarray:
    return np.asarray(np.nan_to_num(np.nanmean(strip.values, axis=2, dtype=np.float64)))


def _search(a: np.ndarray, b: np.ndarray) -> tuple[int, int]:
    """Return (overlap, shift): the first samples of `b` found in `a`, then all of the overlap."""
    import cv2

    shift_room = min(JUMP_SHIFT, min(a.shape[0], b.shape[0]) // 8)
    lines = min(a.shape[0], b.shape[0], SCOUT_LINES)
    start = (min(a.shape[0], b.shape[0]) - lines) // 2
    patch = b[start + shift_room : start + lines - shift_room, :LEAST_OVERLAP].astype(np.float32)
    scores = cv2.matchTemplate(
        a[start : start + lines].astype(np.float32), patch, cv2.TM_CCOEFF_NORMED
    )
    best: tuple[float, int, int] = (-2.0, LEAST_OVERLAP, 0)
    for flat in np.argsort(-np.nan_to_num(scores, nan=-1.0), axis=None, kind="stable")[:20]:
        down, across = np.unravel_index(int(flat), scores.shape)
        overlap, shift = a.shape[1] - int(across), int(down) - shift_room
        if overlap > b.shape[1]:
            continue
        whole = _correlation(*_common_lines(a[:, -overlap:], b[:, :overlap], shift))
        best = max(best, (whole, overlap, shift))
    return best[1], best[2]


def _best_shift(a: np.ndarray, b: np.ndarray) -> int:
    room = min(JUMP_SHIFT, min(a.shape[0], b.shape[0]) // 8)
    shifts = sorted(range(-room, room + 1), key=abs)
    return max(shifts, key=lambda shift: round(_correlation(*_common_lines(a, b, shift)), 9))


def _common_lines(a: np.ndarray, b: np.ndarray, shift: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the lines of `a` and `b` that show the same, a[y] beside b[y − shift]."""
    first, last = max(0, shift), min(a.shape[0], b.shape[0] + shift)
    return a[first:last], b[first - shift : last - shift]


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    one, two = a - a.mean(), b - b.mean()
    scale = np.sqrt(np.sum(one**2) * np.sum(two**2))
    return float(np.sum(one * two) / scale) if scale > 0 else -1.0


def _append(
    left: Calibrated, right: Calibrated, overlap: int, shift: int, blend: bool
) -> Calibrated:
    """Return `left` continued by `right`, which starts `shift` lines further down."""
    height, start = left.values.shape[0], left.values.shape[1] - overlap
    width = start + right.values.shape[1]
    weight = np.zeros(width)
    weight[start:] = 1.0
    ramp = (np.arange(overlap) + 1) / (overlap + 1) if blend else np.arange(overlap) >= overlap // 2
    weight[start : start + overlap] = ramp
    w = weight[None, :, None]
    a = _placed(left, height, width, 0, 0)
    b = _placed(right, height, width, start, shift)
    used_a, used_b = w < 1, w > 0
    values = np.where(used_a, a.values * (1 - w), 0) + np.where(used_b, b.values * w, 0)
    flags = np.where(used_a, a.flags, 0) | np.where(used_b, b.flags, 0)
    variance = None
    if a.variance is not None and b.variance is not None:
        parts = (a.variance * (1 - w) ** 2, b.variance * w**2)
        variance = np.where(used_a, parts[0], 0) + np.where(used_b, parts[1], 0)
        variance = variance.astype(np.float32)
    notes = tuple(dict.fromkeys((*left.notes, *right.notes)))
    return Calibrated(
        values.astype(np.float32), flags.astype(np.uint8), variance, left.quantity, notes
    )


def _placed(strip: Calibrated, height: int, width: int, x: int, y: int) -> Calibrated:
    shape = (height, width, strip.values.shape[2])
    values = np.full(shape, np.nan, np.float32)
    flags = np.full(shape, Flag.OUTSIDE.value, np.uint8)
    variance = None if strip.variance is None else np.full(shape, np.nan, np.float32)
    top, bottom = max(0, y), min(height, strip.values.shape[0] + y)
    to = (slice(top, bottom), slice(x, x + strip.values.shape[1]))
    lines = slice(top - y, bottom - y)
    values[to], flags[to] = strip.values[lines], strip.flags[lines]
    if variance is not None and strip.variance is not None:
        variance[to] = strip.variance[lines]
    return Calibrated(values, flags, variance, strip.quantity, strip.notes)


def _no_overlap(index: int, found: str) -> Problem:
    return Problem(
        "E_STRIPS",
        f"strips {index} and {index + 1} cannot be joined",
        found=found,
        expected="an overlap that looks the same in both",
        fix="Check the order of the strips (left to right), or state the overlaps.",
    )
