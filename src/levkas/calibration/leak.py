"""Light that bright sensels lend to those beside them, until they are full: in exposures that are merged.

A sensel holds a share of the light of each neighbour. In an exposure in which the neighbour is full
that share grows no more, so that the sensel holds less than its own shorter exposures foretell: by
Σ εⱼ·(what the neighbour j would have had above full scale). ε, one number for the four beside and one for the
four at the corners, is a least-squares fit over all such sensels; what they lack is given back to them.
Where the correction is not known well beside the sensel's own noise, that exposure does not count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.templates import Template

UNLIKE = 0.1  # relative: by how much the shares of sensels differ, unless they show more; half of it or half as much again changes the variance of merges by 2 %
MOST_UNLIKE = 0.5  # of shares that are next to nothing every difference is large
MATTERS = (
    0.25  # of a sensel's noise: what the correction may be wrong by; it adds 3 % to the variance
)
FEWEST = 200  # sensels, without which no share is fitted
MOST = 300_000  # sensels of an exposure that are looked at
OUTLIER = 5.0  # sigmas: what moved
ROUNDS = 4
UNKNOWN = 1e20  # counts
BESIDE = np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]], np.float32)
CORNERS = np.array([[1, 0, 1], [0, 0, 0], [1, 0, 1]], np.float32)


class Leak(NamedTuple):
    """Shares of the light of a neighbour that a sensel holds: of those beside, of those at the corners.

    `covariance` of the two; `unlike` is by how much the shares of single sensels differ, relative.
    """

    shares: np.ndarray
    covariance: np.ndarray
    unlike: float


class _Beside(NamedTuple):
    """Sensels beside full ones in one exposure, n of them.

    `at`: where, flat. `excess` (2, n): counts that neighbours would have had above full scale, beside and at corners, `UNKNOWN`
    where no shorter exposure shows them. `lack`: what the sensels have less than shorter exposures foretell, NaN where none
    does; `variance` of it, and `own`, of the sensel alone.
    """

    at: np.ndarray
    excess: np.ndarray
    lack: np.ndarray
    variance: np.ndarray
    own: np.ndarray


def give_back(
    timed: Sequence[Template],
    levels: Sequence[np.ndarray],
    full: Sequence[np.ndarray],
    noise: NoiseModel | None,
    saturation: float,
) -> tuple[list[Template], list[np.ndarray]]:
    """Return exposures with what sensels beside full ones lack, and where that is not known well enough.

    Parameters
    ----------
    timed : sequence of Template, (h, w) or (h, w, b)
        Of different exposures of one scene, shortest first.
    levels : sequence of ndarray that broadcast to them
        Counts without light of each.
    full : sequence of ndarray of bool
        Where sensels are full in each.
    noise : NoiseModel, optional
        Of one shot. None: nothing is given back.
    saturation : float
        Counts.

    Returns
    -------
    shots : list of Template
    apart : list of ndarray of bool
        Sensels that must not count in each exposure, full ones among them.

    Notes
    -----
    A correction is wrong by its standard error, and by what sensels differ beyond their noise; an exposure in which that
    exceeds a quarter of the sensel's noise does not count there. Where no share can be fitted, none next to a full one does.

    Examples
    --------
    Sensels of 100 counts a second between some of 1,000, full at 500, which leak 1 % of their light to each side:

    >>> def shot(t):
    ...     lit = np.tile([[100.0 * t + 0.02 * min(1000 * t, 500), min(1000 * t, 500)]], (40, 20))
    ...     return Template(lit.astype("f4"), None, 1, lit >= 500, lit < 0, t)
    >>> shots = [shot(0.25), shot(1.0)]
    >>> full = [one.saturated for one in shots]
    >>> made, apart = give_back(shots, [np.zeros((1, 1))] * 2, full, NoiseModel(0.5, 4.0), 500.0)
    >>> round(float(made[1].mean[20, 4])), bool(apart[1][20, 4])
    (120, False)
    """
    found = _find(timed, levels, full, saturation, noise or NoiseModel(1.0, 1.0))
    leak = None if noise is None else _fit(found)
    corrected, apart = [], []
    for shot, marks, beside in zip(timed, full, found, strict=True):
        lost = marks.copy()
        if leak is None:
            lost.flat[beside.at] = True
        else:
            leaked = leak.shares @ beside.excess
            wrong = np.einsum("in,ij,jn->n", beside.excess, leak.covariance, beside.excess)
            counts = wrong + (leak.unlike * leaked) ** 2 <= MATTERS**2 * beside.own
            lost.flat[beside.at[~counts]] = True
            mean = shot.mean.copy()
            mean.flat[beside.at[counts]] += leaked[counts]
            shot = replace(shot, mean=mean)
        corrected.append(shot)
        apart.append(lost)
    return corrected, apart


def _find(
    timed: Sequence[Template],
    levels: Sequence[np.ndarray],
    full: Sequence[np.ndarray],
    saturation: float,
    noise: NoiseModel,
) -> list[_Beside]:
    """Compare sensels beside full ones with their shorter exposures, exposure by exposure."""
    found: list[_Beside] = []
    shape = full[0].shape
    known, source = np.zeros(shape, bool), np.zeros(shape, np.uint8)
    rate = np.zeros(shape, np.float32)
    times = np.array([shot.exposure_s or 1.0 for shot in timed])
    counts = np.array([shot.count for shot in timed])
    for k, (shot, level, marks) in enumerate(zip(timed, levels, full, strict=True)):
        signal = shot.mean - level
        beyond = np.maximum(rate * np.float32(times[k]) - (np.float32(saturation) - level), 0)
        beyond[~known] = UNKNOWN
        excess = _around(np.where(marks, beyond, np.float32(0)))
        touched = excess.any(0) & ~marks
        at = np.flatnonzero(touched)
        own = noise.variance(signal.flat[at]) / shot.count
        before = source.flat[at]
        expected = rate.flat[at] * times[before]
        predicted = noise.variance(expected) / counts[before] * (times[k] / times[before]) ** 2
        lack = np.where(known.flat[at], rate.flat[at] * times[k] - signal.flat[at], np.nan)
        planes = excess.reshape(2, -1)[:, at].astype(np.float64)
        found.append(_Beside(at, planes, lack, own + predicted, own))
        # Of full neighbours that no shorter exposure shows, the shortest still bounds the level.
        first = ~marks & ~(touched & known)
        rate[first], source[first] = (signal / np.float32(times[k]))[first], k
        known |= ~marks
    return found


def _around(plane: np.ndarray) -> np.ndarray:
    """Return the sums over the neighbours beside and at the corners of each sensel, (2, h, w), float32."""
    import cv2

    plane = np.ascontiguousarray(plane, np.float32)
    sums = [
        cv2.filter2D(plane, -1, kernel, borderType=cv2.BORDER_CONSTANT).reshape(plane.shape)
        for kernel in (BESIDE, CORNERS)
    ]
    return np.stack(sums)


def _fit(found: Sequence[_Beside]) -> Leak | None:
    """Fit the shares to all exposures; None of too few sensels."""
    parts = []
    for one in found:
        at = np.flatnonzero(np.isfinite(one.lack) & (one.excess.sum(0) < UNKNOWN))
        at = at[:: max(1, len(at) // MOST)]
        parts.append(np.stack([a[at] for a in (*one.excess, one.lack, one.variance)]))
    *excess, lack, variance = np.concatenate(parts, 1)
    if len(lack) < FEWEST:
        return None
    design, kept = np.stack(excess, 1), np.ones(len(lack), bool)
    leak = Leak(np.zeros(2), np.zeros((2, 2)), UNLIKE)
    for _ in range(ROUNDS):
        weight = 1 / (variance + (leak.unlike * (design @ leak.shares)) ** 2)
        normal = (design[kept].T * weight[kept]) @ design[kept]
        covariance = np.linalg.pinv(normal, hermitian=True)
        shares = covariance @ (design[kept].T @ (weight * lack)[kept])
        leaked, rest = design @ shares, lack - design @ shares
        unlike = _unlike(leaked[kept], rest[kept], variance[kept])
        leak = Leak(shares, covariance, unlike)
        kept = rest**2 <= OUTLIER**2 * (variance + (unlike * leaked) ** 2)
    return leak


def _unlike(leaked: np.ndarray, rest: np.ndarray, variance: np.ndarray) -> float:
    """Return by how much shares differ, relative: `UNLIKE`, or what is left beyond noise and chance over what has leaked."""
    weight = float(np.sum(leaked**4 / variance**2))
    if weight <= 0:
        return UNLIKE
    square = float(np.sum((rest**2 - variance) * leaked**2 / variance**2)) / weight
    return float(np.sqrt(np.clip(square - 2 * np.sqrt(2 / weight), UNLIKE**2, MOST_UNLIKE**2)))
