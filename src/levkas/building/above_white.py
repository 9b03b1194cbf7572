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
"""Share of a band that glare may take: gold and varnish under a bad lamp show a fifth. Beyond it the white is too dark."""
DARK, BLACKENED, LEAST_DARK = 0.01, 0.1, 0.002
"""Reflectance up to which a paint is dark; share of dark values that may lie below zero by more than their noise (chance: 2 per
cent); least such share of the object, so that a few sensels count as nothing."""


def count_above(cube: Cube) -> np.ndarray:
    """Count values above the perfect diffuser and below the dark by more than their noise, band by band, without defects.

    Glare that most bands show in one place is that of the surface; what only a few bands show there is their own light.

    Returns
    -------
    counts : ndarray, (6, bands), int64
        Above and all without glare, above and all with it, below zero and dark. Nothing but zeros of counts.

    Examples
    --------
    >>> from levkas.core.cube import Band
    >>> values = np.array([[[0.5], [1.2]]], np.float32)
    >>> count_above(Cube(values, np.zeros(values.shape, np.uint8), None, (Band("R"),)))[:2].tolist()
    [[1], [2]]
    """
    counts = np.zeros((6, len(cube.bands)), np.int64)
    if cube.quantity != "reflectance":
        return counts
    seen = ~is_flagged(cube.flags, LEFT_OUT)
    glare = is_flagged(cube.flags, Flag.GLARE)
    common = glare & (glare.mean(-1, keepdims=True) >= 0.5)
    noise = 0.0 if cube.sigma is None else SURE * cube.sigma
    above = seen & (cube.values > ABOVE + noise)
    dark = seen & (cube.values < DARK) & (cube.sigma is not None)
    parts = (above & ~common, seen & ~common, above, seen, dark & (cube.values < -noise), dark)
    return np.stack([np.count_nonzero(part, axis=(0, 1)) for part in parts]).astype(np.int64)


def describe_above(counts: np.ndarray, labels: Sequence[str]) -> list[str]:
    """Say in which bands more than a few per cent are brighter than the white, or darker than the dark; nothing where none is.

    >>> counts = np.array([[9, 1], [100, 100], [9, 1], [100, 100], [0, 0], [0, 0]])
    >>> describe_above(counts, ["500 nm", "600 nm"])[0][:47]
    '9 % of the object is brighter than a perfect wh'
    """
    without, whole = (counts[k] / np.maximum(counts[k + 1], 1) for k in (0, 2))
    shares = np.where(whole > MUCH, whole, without)
    least = np.where(whole > MUCH, MUCH, FEW)
    below = counts[4] / np.maximum(counts[3], 1)
    black = (below > LEAST_DARK) & (counts[4] > BLACKENED * counts[5])
    said = []
    if (odd := _worst(shares, shares > least)).size:
        said.append(
            f"{100 * shares[odd[0]]:.3g} % of the object is brighter than a perfect white in {_names(odd, labels)}: "
            "check that white and object had one light, exposure and setting"
        )
    if (odd := _worst(below, black)).size:
        said.append(
            f"{100 * below[odd[0]]:.3g} % of the object is darker than its dark by more than noise in {_names(odd, labels)}: the "
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
