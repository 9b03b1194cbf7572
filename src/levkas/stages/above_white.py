"""How much of an object is brighter than its white, darker than its dark, or lit at all: another light, exposure or temperature shows there."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from levkas.calibration.findings import Finding
from levkas.calibration.whites import LIT
from levkas.core.compiled import njit
from levkas.core.cube import Cube, Flag
from levkas.core.threads import in_threads

ABOVE, FEW, NAMED = 1.02, 0.03, 3
"""Reflectance: a board of 0.99 in the picture stays below with its noise. At 1.01 noise counts, at 1.03 a light that is
5 per cent too bright hides. Share of a band that may be brighter, of gold and gloss that is no glare; bands that are named."""
SURE = 2.0
"""Standard deviations by which a value has to be above, so that noise of weak bands counts as nothing: at 1 a sixth of it
does, at 3 a light that is 5 per cent too bright hides in noise of 1 per cent."""
LEFT_OUT = Flag.OUTSIDE | Flag.DEFECT
MUCH = 0.3
"""Share of a band that glare may take; beyond it the white is too dark. Two paintings under one lamp at 45 degrees have 0.09
and 0.11, in a line scanner 0.05 and 0.07."""
SURELY_BELOW, FEW_BELOW = 4.0, 0.002
"""Standard deviations below zero that no noise explains (3 values in 100,000), and share of a band that may lie there."""
ROW, ROW_SURELY = 16, 1.25
"""Values of a row whose mean is looked at, and how many times one value's noise it has to be below zero: five of its own
deviations, 3.5 where neighbours were interpolated from one another. Twice as many values are seldom of one paint."""
ROW_BELOW = 0.0002
"""Reflectance by which such a mean may lie below zero: a tenth of the darkest paint, 0.002."""
COUNTS = 10  # rows of what is counted of each band
MICRO = 1e-6
"""Reflectance in which sums are counted, so that they are the same in whatever parts."""

BRIGHT, FEW_BRIGHT = 5.0, 0.001
"""Standard deviations of a value that is light for certain, and share of such that hot sensels may be."""


def count_above(cube: Cube) -> np.ndarray:
    """Count values above the perfect diffuser and below the dark by more than their noise, band by band, without defects.

    Glare that half of the bands or more show in one place is that of the surface; what fewer show there is light of their own. The
    rows are: above and all beside glare, above and all with it, and below the dark; stretches of 16 values in a row, those whose mean
    is below zero by more than noise, and the sum of these means, 10⁻⁶; above the dark at all, and for certain; zeros of counts.

    >>> from levkas.core.cube import Band
    >>> values = np.array([[[0.5], [1.2], [-0.1]]], np.float32)
    >>> cube = Cube(values, np.zeros(values.shape, np.uint8), np.full(values.shape, 0.01, np.float32), (Band("R"),))
    >>> count_above(cube).ravel().tolist()
    [1, 3, 1, 3, 1, 0, 0, 0, 2, 2]
    """
    if cube.quantity != "reflectance":
        return np.zeros((COUNTS, len(cube.bands)), np.int64)
    known = cube.sigma is not None
    sigma = cube.values if cube.sigma is None else cube.sigma
    marks = np.uint8(LEFT_OUT), np.uint8(Flag.GLARE)
    parts = in_threads(_count, len(cube.values), cube.values, sigma, known, cube.flags, *marks)
    return np.asarray(sum(parts))


@njit(cache=True)
def _count(start, stop, values, sigma, has_sigma, flags, left_out, glare):  # type: ignore[no-untyped-def]
    """Return what `count_above` does of some rows; without sigma it is 0, and nothing is counted below the dark."""
    width, bands = values.shape[1:]
    counts = np.zeros((COUNTS, bands), np.int64)
    total, spread, known = np.zeros(bands), np.zeros(bands), np.zeros(bands, np.int64)
    share = np.float32(1) if has_sigma else np.float32(0)
    for y in range(start, stop):
        for x in range(width):
            glares = 0
            for b in range(bands):
                glares += flags[y, x, b] & glare != 0
            of_surface = 2 * glares >= bands
            for b in range(bands):  # without a branch: several bands are counted at once
                flag, value, noise = flags[y, x, b], values[y, x, b], share * sigma[y, x, b]
                there = flag & left_out == 0
                beside = there & ((not of_surface) | (flag & glare == 0))
                above = value > ABOVE + SURE * noise
                counts[0, b] += beside & above
                counts[1, b] += beside
                counts[2, b] += there & above
                counts[3, b] += there
                counts[4, b] += there & has_sigma & (value < -SURELY_BELOW * noise)
                counts[8, b] += there & (value > 0)
                counts[9, b] += there & (value > BRIGHT * noise)
                total[b] += value if there else np.float32(0)
                spread[b] += noise if there else np.float32(0)
                known[b] += there
            if has_sigma and x % ROW == ROW - 1:
                _count_dark_rows(total, spread, known, counts)
        total[:], spread[:], known[:] = 0, 0, 0  # what is left of a row is no stretch
    return counts


@njit
def _count_dark_rows(total, spread, known, counts):  # type: ignore[no-untyped-def]
    """Count the stretches of a row that are known to the half or more, those that lie below zero, and by how much in all."""
    for b in range(total.size):
        if known[b] >= ROW // 2:
            mean = total[b] / known[b]
            counts[5, b] += 1
            if mean < -max(ROW_SURELY * spread[b] / known[b], ROW_BELOW):
                counts[6, b] += 1
                counts[7, b] += np.int64(np.rint(-mean / MICRO))
        total[b], spread[b], known[b] = 0.0, 0.0, 0


def findings_of_counts(counts: np.ndarray, labels: Sequence[str]) -> Iterator[Finding]:
    """Yield in which bands more than a few per cent are brighter than the white, darker than the dark, or without light; of all that is refused.

    >>> counts = [[9, 1], [100, 100], [9, 1], [100, 100], *[[0, 0]] * 4, [99, 99], [99, 99]]
    >>> [(one.code, one.subject) for one in findings_of_counts(np.array(counts), ["500 nm", "600 nm"])]
    [('above_white', '500 nm (1 of 2 bands)')]
    """
    above, beside, above_in_all, counted, below, rows, rows_below, _, lit, bright = counts
    every = np.maximum(counted, 1)
    unlit = (counted > 0) & (lit < LIT * counted) & (bright < FEW_BRIGHT * counted)
    if unlit.size and unlit.all():
        yield Finding("object_dark", number=float((lit / every).max()))
        return
    shares, least = above / np.maximum(beside, 1), FEW
    if (above_in_all / every > MUCH).any():
        shares, least = above_in_all / every, MUCH
    dark = np.maximum(below / every, rows_below / np.maximum(rows, 1))
    for code, sizes, odd in (
        ("above_white", shares, shares > least),
        ("below_dark", dark, dark > FEW_BELOW),
        ("bands_dark", 1 - lit / every, unlit),
    ):
        worst = np.argsort(-sizes, kind="stable")
        if (worst := worst[odd[worst]]).size:
            names = ", ".join([*(labels[i] for i in worst[:NAMED])])
            more = " …" if len(worst) > NAMED else ""
            subject = f"{names}{more} ({len(worst)} of {len(labels)} bands)"
            yield Finding(code, subject, float(sizes[worst[0]]))
