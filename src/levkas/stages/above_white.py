"""How much of an object is brighter than its white, darker than its dark, or lit at all: another light, exposure or temperature shows there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from levkas.calibration.templates import CalibrationRefused
from levkas.calibration.whites import LIT
from levkas.core.compiled import njit
from levkas.core.cube import Cube, Flag
from levkas.core.problems import Problem
from levkas.core.threads import in_threads

ABOVE = 1.02
"""Reflectance: a board of 0.99 in the picture stays below with its noise. At 1.01 noise counts, at 1.03 a light that is
5 per cent too bright hides."""
FEW = 0.03
"""Share of a band that may be brighter, of gold and gloss that is no glare."""
NAMED = 3
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
COUNTS, LIT_ROW = 10, 8
"""Rows of what is counted of each band, and the row of values above the dark."""
MICRO = 1e-6
"""Reflectance in which sums are counted, so that they are the same in whatever parts."""

BRIGHT, FEW_BRIGHT = 5.0, 0.001
"""Standard deviations of a value that is light for certain, and share of such that hot sensels may be."""


def count_above(cube: Cube) -> np.ndarray:
    """Count values above the perfect diffuser and below the dark by more than their noise, band by band, without defects.

    Glare that half of the bands or more show in one place is that of the surface; what fewer show there is light of their own.

    Returns
    -------
    counts : ndarray, (10, bands), int64
        Above and all beside glare, above and all with it, and below the dark; stretches of 16 values in a row, those whose mean is
        below zero by more than noise, and the sum of these means, 10⁻⁶; above the dark at all, and for certain. Nothing but zeros
        of counts.

    Examples
    --------
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


def require_light(counts: np.ndarray, labels: Sequence[str]) -> None:
    """Refuse an object that is as dark as its dark in all of its bands.

    Raises CalibrationRefused, ``E_NO_LIGHT``.
    """
    if (unlit := _unlit(counts)).size and unlit.size == len(labels):
        least = 100 * (counts[LIT_ROW] / np.maximum(counts[3], 1)).max()
        raise CalibrationRefused(
            Problem(
                "E_NO_LIGHT",
                "the object has no light",
                found=f"no more than {least:.0f} % of the pixels of any band above the dark, as noise alone gives",
                expected="frames that the lamp lit",
                fix="Was a lens cap on, the shutter closed or the lamp off, or are these darks? Capture the object again, or "
                "correct the names.",
            )
        )


def _unlit(counts: np.ndarray) -> np.ndarray:
    """Return the numbers of the bands that have no light."""
    counted, lit, bright = counts[3], counts[LIT_ROW], counts[LIT_ROW + 1]
    return np.flatnonzero((counted > 0) & (lit < LIT * counted) & (bright < FEW_BRIGHT * counted))


def describe_above(counts: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Report in which bands more than a few per cent are brighter than the white, or darker than the dark; nothing where none is.

    >>> counts = [[9, 1], [100, 100], [9, 1], [100, 100], *[[0, 0]] * 4, [99, 99], [99, 99]]
    >>> describe_above(np.array(counts), ["500 nm", "600 nm"])[0][:47]
    '9 % of the object is brighter than a perfect wh'
    """
    above, counted, above_with_glare, counted_with_glare, below, rows, rows_below, amounts = counts[
        :8
    ]
    shares, least = above / np.maximum(counted, 1), FEW
    whole = above_with_glare / np.maximum(counted_with_glare, 1)
    if (whole > MUCH).any():
        shares, least = whole, MUCH
    dark = np.maximum(below / np.maximum(counted_with_glare, 1), rows_below / np.maximum(rows, 1))
    notes = []
    if (odd := _worst(shares, shares > least)).size:
        notes.append(
            f"{100 * shares[odd[0]]:.3g} % of the object is brighter than a perfect white in {_names(odd, labels)}: "
            "check that white and object had one light, exposure and setting"
        )
    if (odd := _worst(dark, dark > FEW_BELOW)).size:
        by = ""
        if (lying := int(rows_below[odd].sum())) > 0:
            by = f", on the mean by a reflectance of {amounts[odd].sum() * MICRO / lying:.2g}"
        notes.append(
            f"{100 * dark[odd[0]]:.3g} % of the object is darker than its dark by more than noise in {_names(odd, labels)}{by}: the "
            "dark was warmer or longer than the object, or saw light. Dark paint is too dark by as much or more; capture darks beside the "
            "object"
        )
    if (odd := _unlit(counts)).size:
        notes.append(
            f"the object has no light in {_names(odd, labels)}, nothing above its dark but noise: the exposure was too short, or "
            "the shutter or a filter closed"
        )
    return notes


def _worst(shares: np.ndarray, odd: np.ndarray) -> np.ndarray:
    """Return the numbers of the bands that are odd, the largest share first."""
    order = np.argsort(-shares, kind="stable")
    return np.asarray(order[odd[order]])


def _names(odd: np.ndarray, labels: Sequence[str]) -> str:
    names = ", ".join(labels[i] for i in odd[:NAMED]) + (" …" if len(odd) > NAMED else "")
    return f"{names} ({len(odd)} of {len(labels)} bands)"
