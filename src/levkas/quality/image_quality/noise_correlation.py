"""A camera that blurs before it hands over its data, found by the noise's autocorrelation.

Noise of neighbouring pixels is independent; a spatial average makes it alike, and makes the SNR look
better than it is (the tunable filter of [mirhashemi2019]_ below 510 nm, Figure 15d). With ρ the
autocorrelation of the noise, σ_true = σ_measured · √(Σ ρ) over lags up to 5 in x and y.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

LAGS = 5
SIGNIFICANT = 5.0
"""Correlation at lag 1 over its own scatter 1/√n that is taken for blur."""
SMALLEST = 0.03
"""Correlation at lag 1 below which blur is of no account, however many pixels prove it."""


class Preblur(NamedTuple):
    """What the noise says of a camera's own blur.

    Parameters
    ----------
    found : bool
    lag1 : (along x, along y)
        Autocorrelation of neighbours.
    factor : float
        True over measured standard deviation, 1 where nothing was found.
    pixels : int
    """

    found: bool
    lag1: tuple[float, float]
    factor: float
    pixels: int

    @property
    def decibels(self) -> float:
        """What is taken off an SNR, dB of Eq. (1)."""
        return 10 * float(np.log10(self.factor))


def find_preblur(noise: np.ndarray | Sequence[np.ndarray], *, fitted: int = 1) -> Preblur:
    """Tell whether a camera blurred, from the noise of uniform areas.

    Parameters
    ----------
    noise : ndarray, (h, w), or a sequence of them
        Raw differences of two shots, or what a fitted plane leaves of uniform patches; pooled,
        each by its own mean and weight. Never demosaiced values: these are correlated anyway.
    fitted : int
        Parameters that were fitted to each area: 1 for its mean, 3 for a plane. They take away
        correlation with what they fit, which is put back.

    Returns
    -------
    preblur : Preblur

    Raises
    ------
    ValueError
        Where no area has more than 5 pixels along both sides.

    Examples
    --------
    >>> rng = np.random.default_rng(1); white = rng.standard_normal((200, 200))
    >>> box = sum(np.roll(white, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9
    >>> find_preblur(white).found, round(find_preblur(box).factor, 1)
    (False, 3.0)
    """
    areas = [noise] if isinstance(noise, np.ndarray) else list(noise)
    areas = [np.asarray(a, float) for a in areas if min(a.shape) > LAGS]
    if not areas:
        raise ValueError(f"no area is larger than {LAGS} x {LAGS} pixels")
    sums, pairs = np.zeros((LAGS + 1, 2 * LAGS + 1)), np.zeros((LAGS + 1, 2 * LAGS + 1))
    for area in areas:
        centred = area - area.mean()
        scale = centred.std()
        if scale > 0:
            _add_products(centred / scale, sums, pairs)
    correlation = sums / np.maximum(pairs, 1)
    if correlation[0, LAGS] <= 0:
        return Preblur(False, (0.0, 0.0), 1.0, 0)
    correlation /= correlation[0, LAGS]
    pixels = int(pairs[0, LAGS])
    lag1 = float(correlation[0, LAGS + 1]), float(correlation[1, LAGS])
    limit = max(SIGNIFICANT / np.sqrt(pixels), SMALLEST)
    if max(lag1) <= limit:
        return Preblur(False, lag1, 1.0, pixels)
    reach = _reach(correlation, limit)
    near = correlation[: reach + 1, LAGS - reach : LAGS + reach + 1]
    total = 1 + 2 * (near[0, reach + 1 :].sum() + near[1:].sum())
    # Of autocovariance a fit takes p S/n at every lag: total = (S − lags · p S/n)/(1 − p S/n).
    share = fitted / (pixels / len(areas))
    total /= max(1 - (2 * reach + 1) ** 2 * share + total * share, 0.1)
    return Preblur(True, lag1, float(np.sqrt(max(total, 1.0))), pixels)


def _reach(correlation: np.ndarray, limit: float) -> int:
    """Return the largest lag that still counts: past it there is only the scatter of the estimate."""
    along = np.maximum(correlation[0, LAGS + 1 :], correlation[1:, LAGS])
    below = np.flatnonzero(along < limit)
    return int(below[0]) + 1 if len(below) else LAGS


def _add_products(area: np.ndarray, sums: np.ndarray, pairs: np.ndarray) -> None:
    """Products of pixels (dy, dx) apart, for dy 0 … 5 and dx −5 … 5."""
    height, width = area.shape
    for dy in range(LAGS + 1):
        for dx in range(-LAGS, LAGS + 1):
            a = area[: height - dy, max(0, -dx) : width - max(0, dx)]
            b = area[dy:, max(0, dx) : width - max(0, -dx)]
            sums[dy, dx + LAGS] += float(np.einsum("ij,ij->", a, b))
            pairs[dy, dx + LAGS] += a.size
