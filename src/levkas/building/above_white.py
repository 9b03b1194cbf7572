"""How much of an object is brighter than its white: a white of another light or exposure shows there."""

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
LEFT_OUT = Flag.OUTSIDE | Flag.DEFECT | Flag.GLARE


def count_above(cube: Cube) -> np.ndarray:
    """Count values above the perfect diffuser by more than their noise, and all, band by band, without glare and defects.

    Returns
    -------
    counts : ndarray, (2, bands), int64
        Nothing but zeros of counts.

    Examples
    --------
    >>> from levkas.core.cube import Band
    >>> values = np.array([[[0.5], [1.2]]], np.float32)
    >>> count_above(Cube(values, np.zeros(values.shape, np.uint8), None, (Band("R"),))).tolist()
    [[1], [2]]
    """
    counts = np.zeros((2, len(cube.bands)), np.int64)
    if cube.quantity == "reflectance":
        seen = ~is_flagged(cube.flags, LEFT_OUT)
        least = ABOVE if cube.sigma is None else ABOVE + SURE * cube.sigma
        counts[0] = np.count_nonzero(seen & (cube.values > least), axis=(0, 1))
        counts[1] = np.count_nonzero(seen, axis=(0, 1))
    return counts


def describe_above(counts: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Say in which bands more than a few per cent are brighter than the white; nothing where none is.

    >>> describe_above(np.array([[9, 1], [100, 100]]), ["500 nm", "600 nm"])[0][:47]
    '9 % of the object is brighter than a perfect wh'
    """
    shares = counts[0] / np.maximum(counts[1], 1)
    odd = [i for i in np.argsort(-shares, kind="stable") if shares[i] > FEW]
    if not odd:
        return []
    names = ", ".join(labels[i] for i in odd[:NAMED]) + (" …" if len(odd) > NAMED else "")
    return [
        f"{100 * shares[odd[0]]:.2g} % of the object is brighter than a perfect white in {names} ({len(odd)} of "
        f"{len(labels)} bands): check that white and object had one light, exposure and setting"
    ]
