"""What changed between two pictures of one painting: pixels that differ by more than their uncertainties.

The differences of all bands, each over its standard deviation, make one squared distance d' C⁻¹ d ([reed1990]_), for every pixel and for means of
5 x 5. C is what bands share without a change: it is taken from the nine tenths of the pixels that differ least, twice. Without a change the
distance is distributed like a scaled chi square; scale and degrees of freedom are fitted to its quartiles, which few changed pixels do not
move, so that the rate of false alarms is the stated one whatever bands and neighbours share.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SIDE = 5
"""Pixels a side of the means: a change of 0.01 over so many is found beside noise of 0.005."""
LEAST = 400
"""Pixels to fit a distribution to."""
NOISE_FLOOR = 1e-6
MOST = 100_000
"""Pixels from which it is found what bands share, and how well places are known."""
FLAT, STEEP = 0.5, 0.8
"""Quantiles of the slope: the flatter half of a picture, and its steepest fifth."""
HALVINGS = 24
"""Of 1 px²: to 0.0003 px."""


@dataclass(frozen=True, eq=False)
class Changes:
    """Pixels that changed."""

    mask: np.ndarray
    known: np.ndarray
    rate: float
    areas: tuple[tuple[int, int, int, int, float], ...]

    @property
    def share(self) -> float:
        """Share of the compared pixels that are marked."""
        return float(self.mask.sum() / max(int(self.known.sum()), 1))


def find_changes(
    difference: np.ndarray, variance: np.ndarray, known: np.ndarray, *, rate: float = 0.01
) -> Changes:
    """Find pixels whose spectra differ.

    Parameters
    ----------
    difference : ndarray, (h, w, bands)
        Of two registered pictures, without what they differ by as a whole.
    variance : ndarray like `difference`
        Of its random part, with that of the place.
    known : ndarray, (h, w), bool
        Pixels that are sound in both.
    rate : float
        Of false alarms, of both tests together.

    Returns
    -------
    changes : Changes
        Nothing is marked where fewer than 400 pixels are known.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> apart = rng.normal(0, 0.005, (60, 60, 4))
    >>> apart[20:25, 30:35] += 0.02
    >>> found = find_changes(apart, np.full(apart.shape, 0.005**2), np.ones((60, 60), bool), rate=0.001)
    >>> bool(found.mask[22, 32]), round(found.areas[0][4], 2)
    (True, 0.01)
    """
    from scipy import ndimage
    from scipy.stats import chi2

    if known.sum() < LEAST:
        return Changes(np.zeros_like(known), known, rate, ())
    z = np.where(known[..., None], difference / np.sqrt(np.maximum(variance, NOISE_FLOOR**2)), 0.0)
    count = ndimage.uniform_filter(known.astype(float), SIDE, mode="constant")
    means = ndimage.uniform_filter(z, (SIDE, SIDE, 1), mode="constant")
    enough = known & (count > 0.5)
    # Of unit variance where neighbours share nothing, beside what is not known too.
    means *= SIDE / np.sqrt(np.maximum(count, 0.5))[..., None]
    bands = difference.shape[2]
    mask = np.zeros_like(known)
    for one, where in ((z, known), (means, enough)):
        above = np.square(one).sum(-1) > chi2.ppf(1 - rate / 2, bands)
        mask |= above & _above(_distances(one, where), where, rate / 2)
    return Changes(mask, known, rate, _areas(mask, difference))


def apparent_place(
    difference: np.ndarray, variance: np.ndarray, steepness: np.ndarray, known: np.ndarray
) -> float:
    """Return the variance of the place, px², with which steep parts of two pictures differ as flat ones do.

    It holds what a registration misses and what interpolation makes of edges; 0 where steep parts differ no more than flat ones.

    Parameters
    ----------
    difference, variance : ndarray, (h, w, bands)
        As in `find_changes`, without the variance of the place.
    steepness : ndarray like `difference`, 1/px²
        Squared slope of the picture.
    known : ndarray, (h, w), bool

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> steep = np.broadcast_to(np.linspace(0, 0.2, 100)[:, None], (100, 100, 2)) ** 2
    >>> apart = rng.normal(0, np.sqrt(0.005**2 + 0.1**2 * steep))
    >>> found = apparent_place(apart, np.full(apart.shape, 0.005**2), steep, np.ones((100, 100), bool))
    >>> round(found**0.5, 2)
    0.1
    """
    at = np.argwhere(known)
    at = at[:: max(1, len(at) // MOST)]
    if len(at) < LEAST:
        return 0.0
    square, spread, slope = (
        one[at[:, 0], at[:, 1]] for one in (np.square(difference), variance, steepness)
    )
    spread = np.maximum(spread, NOISE_FLOOR**2)
    mean = slope.mean(-1)
    flat, steep = mean <= np.quantile(mean, FLAT), mean >= np.quantile(mean, STEEP)

    def excess(place: float) -> float:
        sizes = square / (spread + place * slope)
        return float(np.median(sizes[steep]) - np.median(sizes[flat]))

    low, high = 0.0, 1.0
    if excess(low) <= 0:
        return low
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


def _distances(z: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Return the squared distance of each pixel, (h, w), with what bands share among those that differ least."""
    rows = z[known]
    some = rows[:: max(1, len(rows) // MOST)]
    near = some
    for _ in range(2):
        shared = near.T @ near / len(near)
        shared += 1e-6 * np.trace(shared) / len(shared) * np.eye(len(shared))
        inverse = np.linalg.inv(shared)
        apart = np.einsum("ni,ij,nj->n", some, inverse, some)
        near = some[apart <= np.quantile(apart, 0.9)]
    found = np.zeros(known.shape)
    found[known] = np.einsum("ni,ij,nj->n", rows, inverse, rows)
    return found


def _above(squares: np.ndarray, known: np.ndarray, rate: float) -> np.ndarray:
    """Mark what lies above all but a share of a scaled chi square with the same quartiles."""
    from scipy.optimize import brentq
    from scipy.stats import chi2

    low, middle, high = np.quantile(squares[known], (0.25, 0.5, 0.75))
    if not high > low > 0:
        return np.zeros_like(known)

    def miss(logarithm: float) -> float:
        a, b, c = chi2.ppf((0.25, 0.5, 0.75), np.exp(logarithm))
        return float((c - a) / b - (high - low) / middle)

    ends = np.log(0.3), np.log(1e4)
    freedom = float(np.exp(brentq(miss, *ends))) if miss(ends[0]) > 0 > miss(ends[1]) else 1.0
    scale = middle / chi2.ppf(0.5, freedom)
    return np.asarray(known & (squares > scale * chi2.ppf(1 - rate, freedom)))


def _areas(
    mask: np.ndarray, difference: np.ndarray, most: int = 10, least: int = 9
) -> tuple[tuple[int, int, int, int, float], ...]:
    """Return rectangles about connected areas of some pixels, the largest first."""
    from scipy import ndimage

    labels, count = ndimage.label(mask, np.ones((3, 3)))
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    found = []
    slices = ndimage.find_objects(labels)
    for k in sorted(range(1, count + 1), key=lambda k: -int(sizes[k]))[:most]:
        rows, columns = slices[k - 1]
        if sizes[k] >= least:
            inside = labels[rows, columns] == k
            mean = float(difference[rows, columns][inside].mean())
            found.append(
                (
                    int(columns.start),
                    int(rows.start),
                    int(columns.stop - columns.start),
                    int(rows.stop - rows.start),
                    mean,
                )
            )
    return tuple(found)
