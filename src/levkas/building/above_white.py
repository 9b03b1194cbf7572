"""How much of an object is brighter than its white, or darker than its dark: another light, exposure or temperature shows there."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from levkas.core.cube import Cube, Flag, is_flagged

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


def count_above(cube: Cube) -> np.ndarray:
    """Count values above the perfect diffuser and below the dark by more than their noise, band by band, without defects.

    Glare that half of the bands or more show in one place is that of the surface; what fewer show there is light of their own.

    Returns
    -------
    counts : ndarray, (5, bands), int64
        Above and all beside glare, above and all with it, and below. Nothing but zeros of counts.

    Examples
    --------
    >>> from levkas.core.cube import Band
    >>> values = np.array([[[0.5], [1.2], [-0.1]]], np.float32)
    >>> cube = Cube(values, np.zeros(values.shape, np.uint8), np.full(values.shape, 0.01, np.float32), (Band("R"),))
    >>> count_above(cube).ravel().tolist()
    [1, 3, 1, 3, 1]
    """
    if cube.quantity != "reflectance":
        return np.zeros((5, len(cube.bands)), np.int64)
    seen = ~is_flagged(cube.flags, LEFT_OUT)
    above = seen & (cube.values > (ABOVE if cube.sigma is None else ABOVE + SURE * cube.sigma))
    with_glare = [_of_bands(above), _of_bands(seen)]
    beside = with_glare
    glare = is_flagged(cube.flags, Flag.GLARE)
    if glare.any():
        paint = glare.mean(-1, keepdims=True) < 0.5
        beside = [_of_bands(above & (paint | ~glare)), _of_bands(seen & (paint | ~glare))]
    below = np.zeros(len(cube.bands), np.int64)
    if cube.sigma is not None:
        below = _of_bands(seen & (cube.values < -SURELY_BELOW * cube.sigma))
    return np.stack([*beside, *with_glare, below])


def _of_bands(marked: np.ndarray) -> np.ndarray:
    """Return how many values of each band are marked, (bands,); view by view takes 0.1 to 0.7 of the time of one count over two axes."""
    return np.array([np.count_nonzero(marked[..., k]) for k in range(marked.shape[-1])], np.int64)


def describe_above(counts: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Say in which bands more than a few per cent are brighter than the white, or darker than the dark; nothing where none is.

    >>> describe_above(np.array([[9, 1], [100, 100], [9, 1], [100, 100], [0, 0]]), ["500 nm", "600 nm"])[0][:47]
    '9 % of the object is brighter than a perfect wh'
    """
    above, seen, above_with_glare, seen_with_glare, below = counts
    shares, least = above / np.maximum(seen, 1), FEW
    whole = above_with_glare / np.maximum(seen_with_glare, 1)
    if (whole > MUCH).any():
        shares, least = whole, MUCH
    dark = below / np.maximum(seen_with_glare, 1)
    said = []
    if (odd := _worst(shares, shares > least)).size:
        said.append(
            f"{100 * shares[odd[0]]:.3g} % of the object is brighter than a perfect white in {_names(odd, labels)}: "
            "check that white and object had one light, exposure and setting"
        )
    if (odd := _worst(dark, dark > FEW_BELOW)).size:
        said.append(
            f"{100 * dark[odd[0]]:.3g} % of the object is darker than its dark by more than noise in {_names(odd, labels)}: the "
            "dark was warmer or longer than the object, or saw light. Dark paint is too dark by as much; capture darks beside the object"
        )
    return said


def _worst(shares: np.ndarray, odd: np.ndarray) -> np.ndarray:
    """Return the numbers of the bands that are odd, the largest share first."""
    order = np.argsort(-shares, kind="stable")
    return np.asarray(order[odd[order]])


def _names(odd: np.ndarray, labels: Sequence[str]) -> str:
    names = ", ".join(labels[i] for i in odd[:NAMED]) + (" …" if len(odd) > NAMED else "")
    return f"{names} ({len(odd)} of {len(labels)} bands)"
