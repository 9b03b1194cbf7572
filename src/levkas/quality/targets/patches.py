"""Signal and noise of a chart's patches (Figure 15 of [mirhashemi2019]_), and blur found by the noise.

Noise of neighbouring pixels is independent; a spatial average in the camera makes it alike, and makes the SNR
look better than it is (the tunable filter of [mirhashemi2019]_ below 510 nm, Figure 15d). With ρ the
autocorrelation of the noise, σ_true = σ_measured · √(Σ ρ) over lags up to 5 in x and y.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.core.cube import Flag, is_flagged
from levkas.quality.targets.charts import pixels_of

if TYPE_CHECKING:
    from collections.abc import Sequence

SATURATED = 0.01
"""Share of a patch's pixels that may saturate: single hot sensels do."""
LEAST_PIXELS = 9
"""Of a patch: fewer show no noise about a plane."""


@dataclass(frozen=True, eq=False)
class PatchTable:
    """What the patches of a chart gave, band by band.

    Parameters
    ----------
    mean, noise : ndarray, (patches, bands)
        In the unit of the cube; `noise` is the standard deviation of a pixel.
    saturated : ndarray, (patches, bands)
        Share of pixels that are.
    pixels : ndarray, (patches,)
    temporal : bool
        Whether the noise is that of the difference of two shots; else what a fitted plane leaves,
        which holds the chart's own texture, too.
    quantised : ndarray, (patches, bands), bool
        Whether rounding to codes, step²/12, is over half of the variance of one shot.
    """

    mean: np.ndarray
    noise: np.ndarray
    saturated: np.ndarray
    pixels: np.ndarray
    temporal: bool
    quantised: np.ndarray

    @property
    def snr(self) -> np.ndarray:
        """Mean over noise, linear; NaN where over 1 % of a patch saturates, or it is not above dark."""
        good = (self.mean > 0) & (self.noise > 0) & (self.saturated <= SATURATED)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(good, self.mean / self.noise, np.nan)

    @property
    def snr_db(self) -> np.ndarray:
        """The same in dB of Eq. (1), 10·log10: half of EMVA 1288's."""
        return np.asarray(10 * np.log10(self.snr))

    def corrected_db(self, preblurs: list[Preblur | None]) -> np.ndarray:
        """Return `snr_db` with what a camera's own blur has hidden taken off, band by band."""
        lost = np.array([p.decibels if p is not None and p.found else 0.0 for p in preblurs])
        return self.snr_db - lost


def measure_patches(
    values: np.ndarray,
    flags: np.ndarray,
    areas: np.ndarray,
    *,
    shots: tuple[np.ndarray, np.ndarray] | None = None,
    steps: np.ndarray | Sequence[float] | None = None,
    count: int = 1,
    pattern: np.ndarray | None = None,
    common: np.ndarray | None = None,
) -> PatchTable:
    """Measure every patch in every band.

    Parameters
    ----------
    values : ndarray, (h, w, bands)
        Reflectance, or counts above dark.
    flags : ndarray like `values`, uint8
        Defects are left out, saturation is reported.
    areas : ndarray, (n, 4, 2), px
        From `charts.place_patches`.
    shots : two ndarrays like `values`, optional
        Independent halves whose mean is `values`: the noise is then that of half their difference.
    steps : (bands,) or (n, bands), optional
        What a step from code to code is of the values; 0 where that is not known.
    count : int
        Shots that `values` are the mean of.
    pattern : ndarray, (rows, columns), int, optional
        Band of each sensel of a mosaic. Noise is then that of the sensels which measured a band:
        the mean of neighbours, which lies between them, has less.
    common : ndarray like `values`, optional
        Variance that both halves of `shots` share and their difference does not show: of white and dark.

    Notes
    -----
    A plane is fitted to each patch first: shading is no noise. Rounding that a patch of hardly any noise
    does not show, being the same code all over, is added: `noise_fit.hidden_rounding`. Two counts of 8 bits
    without noise have the SNR 2/√(1/12) = 6.9.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> shot = 0.5 + 0.01 * np.arange(60)[None, :, None] / 60 + 0.02 * rng.standard_normal((60, 60, 1))
    >>> area = np.array([[[5, 5], [54, 5], [54, 54], [5, 54.0]]])
    >>> table = measure_patches(shot, np.zeros(shot.shape, np.uint8), area)
    >>> round(float(table.snr[0, 0])), round(float(table.snr_db[0, 0]), 1)
    (25, 14.0)
    """
    bands = values.shape[2]
    mean, noise, saturated = (np.full((len(areas), bands), np.nan) for _ in range(3))
    quantised = np.zeros((len(areas), bands), bool)
    pixels = np.zeros(len(areas), int)
    coarse = np.broadcast_to(0.0 if steps is None else np.asarray(steps, float), mean.shape)
    for i, area in enumerate(areas):
        rows, columns = pixels_of(area)
        pixels[i] = len(rows)
        part, bits = values[rows, columns].astype(float), flags[rows, columns]
        noisy = part if shots is None else (shots[0] - shots[1])[rows, columns].astype(float) / 2
        good = ~is_flagged(bits, Flag.DEFECT | Flag.OUTSIDE) & np.isfinite(part)
        saturated[i] = is_flagged(bits, Flag.SATURATED).mean(0)
        for band in range(bands):
            use = good[:, band]
            if np.count_nonzero(use) < LEAST_PIXELS:
                continue
            mean[i, band] = part[use, band].mean()
            if pattern is not None:
                height, width = pattern.shape
                use = use & (pattern[rows % height, columns % width] == band)
            if np.count_nonzero(use) < LEAST_PIXELS:
                continue
            spread = spread_about_plane(noisy[use, band], rows[use], columns[use])
            noise[i, band], quantised[i, band] = _rounded(spread, coarse[i, band], count)
            if common is not None and shots is not None:
                more = float(np.nanmean(common[rows[use], columns[use], band]))
                noise[i, band] = np.sqrt(noise[i, band] ** 2 + max(more, 0.0))
    return PatchTable(mean, noise, saturated, pixels, shots is not None, quantised)


def spread_about_plane(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> float:
    """Return the standard deviation of pixels about a fitted plane."""
    basis = np.column_stack([np.ones(len(values)), rows - rows.mean(), columns - columns.mean()])
    left = values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0]
    return float(np.sqrt(left @ left / (len(values) - 3)))


def _rounded(noise: float, step: float, count: int) -> tuple[float, bool]:
    """Return the noise of a mean of shots with the rounding that all of them share, and whether that is most of it."""
    from levkas.calibration.noise_fit import whole_variance

    shown = count * noise**2
    whole = float(whole_variance(shown, step))
    return float(np.sqrt(noise**2 + whole - shown)), step**2 / 12 > whole / 2


def noise_planes(
    values: np.ndarray, areas: np.ndarray, *, shots: tuple[np.ndarray, np.ndarray] | None = None
) -> list[list[np.ndarray]]:
    """Return, band by band, the noise of every patch's upright inner rectangle, plane removed, one spread.

    For `find_preblur`.
    """
    found: list[list[np.ndarray]] = [[] for _ in range(values.shape[2])]
    for area in areas:
        low = np.ceil(np.sort(area, axis=0)[1]).astype(int)
        high = np.floor(np.sort(area, axis=0)[2]).astype(int) + 1
        inner = np.s_[low[1] : high[1], low[0] : high[0]]
        block = values[inner] if shots is None else shots[0][inner] - shots[1][inner]
        rows, columns = np.mgrid[: block.shape[0], : block.shape[1]]
        basis = np.column_stack([np.ones(rows.size), rows.ravel(), columns.ravel()]).astype(float)
        flat = block.reshape(rows.size, -1).astype(float)
        if len(flat) <= 9:
            continue
        left = flat - basis @ np.linalg.lstsq(basis, flat, rcond=None)[0]
        for band in range(values.shape[2]):
            found[band].append(left[:, band].reshape(rows.shape))
    return found


LAGS = 5
SIGNIFICANT = 5.0
"""Correlation at lag 1 over its own scatter 1/√n that is taken for blur."""
SMALLEST = 0.03
"""Correlation at lag 1 below which blur is of no account, however many pixels prove it."""


class Preblur(NamedTuple):
    """A camera's own blur: autocorrelation of neighbours along x and y, and true over measured standard deviation, 1 without any."""

    found: bool
    lag1: tuple[float, float]
    factor: float
    pixels: int

    @property
    def decibels(self) -> float:
        """What is taken off an SNR, dB of Eq. (1)."""
        return 10 * float(np.log10(self.factor))


def find_preblur(noise: np.ndarray | Sequence[np.ndarray], *, fitted: int = 1) -> Preblur:
    """Find whether a camera blurred, from the noise of uniform areas.

    Parameters
    ----------
    noise : ndarray, (h, w), or a sequence of them
        Raw differences of two shots, or what a fitted plane leaves of uniform patches; pooled,
        each by its own mean and weight. Never demosaiced values: these are correlated anyway.
    fitted : int
        Parameters that were fitted to each area: 1 for its mean, 3 for a plane. They take away
        correlation with what they fit, which is put back.

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
