"""How much of an object is brighter than its white, darker than its dark, or lit at all: another light, exposure or temperature shows there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from levkas.calibration.templates import CalibrationRefused
from levkas.calibration.whites import LIT
from levkas.core.cube import Cube, Flag, is_flagged
from levkas.core.problems import Problem

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
    counted = ~is_flagged(cube.flags, LEFT_OUT)
    above = counted & (cube.values > (ABOVE if cube.sigma is None else ABOVE + SURE * cube.sigma))
    with_glare = [_of_bands(above), _of_bands(counted)]
    beside = with_glare
    glare = is_flagged(cube.flags, Flag.GLARE)
    if glare.any():
        paint = glare.mean(-1, keepdims=True) < 0.5
        beside = [_of_bands(above & (paint | ~glare)), _of_bands(counted & (paint | ~glare))]
    dark = np.zeros((4, len(cube.bands)), np.int64)
    lit = _of_bands(counted & (cube.values > 0))
    bright = lit
    if cube.sigma is not None:
        dark[0] = _of_bands(counted & (cube.values < -SURELY_BELOW * cube.sigma))
        dark[1:] = _count_dark_rows(cube.values, cube.sigma, counted)
        bright = _of_bands(counted & (cube.values > BRIGHT * cube.sigma))
    return np.stack([*beside, *with_glare, *dark, lit, bright])


def _count_dark_rows(values: np.ndarray, sigma: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """Return how many stretches of a row are known to the half or more, how many lie below zero, and by how much in all, (3, bands)."""
    height, width, bands = values.shape
    whole = width // ROW * ROW
    value, noise, known = (
        array[:, :whole].reshape(height, -1, ROW, bands) for array in (values, sigma, counted)
    )
    count = known.sum(2)
    means, spread = (
        np.sum(array, axis=2, dtype=np.float64, where=known) / np.maximum(count, 1)
        for array in (value, noise)
    )
    known = count >= ROW // 2
    below = known & (means < -np.maximum(ROW_SURELY * spread, ROW_BELOW))
    amounts = np.rint(np.where(below, -means, 0) / MICRO).astype(np.int64)
    return np.stack([known.sum((0, 1)), below.sum((0, 1)), amounts.sum((0, 1))])


def require_light(counts: np.ndarray, labels: Sequence[str]) -> None:
    """Refuse an object that is as dark as its dark in all of its bands.

    Raises
    ------
    CalibrationRefused
        ``E_NO_LIGHT``.
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


def _of_bands(marked: np.ndarray) -> np.ndarray:
    """Return how many values of each band are marked, (bands,); view by view takes 0.1 to 0.7 of the time of one count over two axes."""
    return np.array([np.count_nonzero(marked[..., k]) for k in range(marked.shape[-1])], np.int64)


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
