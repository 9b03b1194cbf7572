"""Chromatic shifts of the bands of one camera, pooled over several captures of it.

Lateral colour belongs to the lens and to the filters, not to the painting. Every capture measures the
same amounts with its own errors; how much they really differ from capture to capture (a filter that is
put in anew, another focus) shows in them as well. Each capture is then drawn to what the others say, as
far as they agree: a meta-analysis with random effects ([dersimonian1986]_), pooled over the bands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from levkas.registration.chromatic import ChromaticShifts, groups_of

#: Amounts, px², are never known better than this.
LEAST_VARIANCE = 1e-10
ROUNDS = 5


def pool_chromatic(measured: Sequence[ChromaticShifts], which: int = 0) -> ChromaticShifts:
    """Return the fields of one capture, drawn to those of the others.

    Parameters
    ----------
    measured : sequence of Chromatic
        Of the same bands in the same order and the same frame, one a capture.
    which : int
        The capture.

    Returns
    -------
    shared : Chromatic
        One alone comes back as it is. A band that was measured nowhere stays.

    Notes
    -----
    What all bands of a capture have in common belongs to its base map and is never shared: base maps
    may weigh the bands differently.
    """
    one = measured[which]
    if len(measured) < 2:
        return one
    amounts, known = _stacked(measured)
    common = _common(amounts, known)
    spread = _between(amounts - common, known)
    others = np.arange(len(measured)) != which
    with np.errstate(divide="ignore"):
        told = np.where(known > 0, 1 / (1 / known + spread), 0.0)[others]
        total = told.sum(0)
        prior = np.where(total > 0, 1 / (1 / total + spread), 0.0)
    expected = _mean(told, (amounts - common)[others]) + common[which]
    mine = known[which]
    whole = mine + prior
    values = (mine * amounts[which] + prior * expected) / np.where(whole > 0, whole, 1.0)
    fixed = ~one.amounts.any(1) & (whole > 0).any(1)
    values = np.where((whole > 0) & ~fixed[:, None], values, amounts[which])
    return _told(one, measured, values, whole, mine)


def _told(
    one: ChromaticShifts,
    measured: Sequence[ChromaticShifts],
    values: np.ndarray,
    whole: np.ndarray,
    known: np.ndarray,
) -> ChromaticShifts:
    kind = max((m.kind for m in measured), key=lambda kind: groups_of(kind)[-1][1])
    if one.variances is None:
        return replace(one, kind=kind, amounts=values)
    before = np.zeros_like(values)
    before[:, : one.variances.shape[1]] = one.variances
    with np.errstate(divide="ignore"):
        variances = np.where(known > 0, 1 / whole, before)
    return replace(one, kind=kind, amounts=values, variances=variances)


def _stacked(measured: Sequence[ChromaticShifts]) -> tuple[np.ndarray, np.ndarray]:
    """Amounts and inverse variances, (captures, bands, fields); 0 where nothing is known."""
    bands, width = len(measured[0].amounts), max(m.amounts.shape[1] for m in measured)
    amounts, known = np.zeros((2, len(measured), bands, width))
    for k, one in enumerate(measured):
        size = one.amounts.shape[1]
        amounts[k, :, :size] = one.amounts
        if one.variances is not None:
            known[k, :, :size] = 1 / np.maximum(one.variances, LEAST_VARIANCE)
    return amounts, known


def _mean(weights: np.ndarray, values: np.ndarray) -> np.ndarray:
    total = weights.sum(0)
    return np.asarray((weights * values).sum(0) / np.where(total > 0, total, 1.0))


def _common(amounts: np.ndarray, known: np.ndarray) -> np.ndarray:
    """What all bands of a capture have more than those of the others, (captures, 1, fields)."""
    common = np.zeros((len(amounts), 1, amounts.shape[2]))
    total = known.sum(1, keepdims=True)
    for _ in range(ROUNDS):
        apart = amounts - _mean(known, amounts - common)
        common = (known * apart).sum(1, keepdims=True) / np.where(total > 0, total, 1.0)
        common -= common.mean(0)
    return common


def _between(apart: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Variance between captures of every field, (fields,) px², one for the fields of a group."""
    spread = np.zeros(apart.shape[2])
    squares = (known * (apart - _mean(known, apart)) ** 2).sum(0)
    total, twice = known.sum(0), (known**2).sum(0)
    times = (known > 0).sum(0)
    for first, last in groups_of("cubic"):
        part = np.zeros(times.shape, bool)
        part[:, first:last] = times[:, first:last] > 1
        if part.any():
            excess = (squares - (times - 1))[part].sum()
            scale = (total[part] - twice[part] / total[part]).sum()
            spread[first:last] = max(float(excess / scale), 0.0)
    return spread
